"""Claim: the start of a step without contact approaches no plane within its dhat and leaves sliding alone,
differentiated as executed. Two codes say where it lies, a header and the reference."""

import itertools

import numpy as np
import pytest
import torch
from torch import Tensor

from diffvbd._common.constants import FILTER_ETA
from diffvbd.model.bodies import Bodies, OtherBodies
from diffvbd.reference.energies import FloorBarrier
from diffvbd.step.arguments import LOOKBACK
from diffvbd.step.predict import start_of as begin
from diffvbd.testing import generator, relative_error, tolerance

PLANES = {
    "floor": ((0.0, 1.0, 0.0),),
    "tilted": ((0.3, 0.9, -0.3),),
    "valley": ((0.6, 0.8, 0.0), (-0.8, 0.6, 0.3)),
    "narrow": ((1.0, 0.1, 0.0), (-1.0, 0.2, 0.1)),
    "ridge": ((0.6, 0.8, 0.0), (0.5, 0.8, 0.2)),
    "corner": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "pyramid": ((0.7, 0.7, 0.0), (-0.7, 0.7, 0.1), (0.1, 0.7, 0.7), (0.0, 0.7, -0.7)),
    # no four of them through one point, where it would be open which of them bind
    "eight": tuple((a, b + 0.1 * a * c, c) for a, b, c in itertools.product((1.0, -1.1), (0.9, -1.1), (1.2, -0.8))),
}
DHAT = 0.1
VERTICES = 300


def inputs(name: str) -> dict[str, Tensor]:
    """Two scenes, with gaps of 0.3 and 5 dhat at the origin; vertices about it, steps from a millimetre to metres."""
    rng = generator("floor start", name)
    normal = np.array([np.divide(n, np.linalg.norm(n)) for n in PLANES[name]])
    height = -DHAT * np.array([[0.3], [5.0]]).repeat(len(normal), 1)
    x = rng.normal(size=(2, VERTICES, 3)) * 10 ** rng.uniform(-2, 0, (2, VERTICES, 1))
    for _ in range(20):
        below = ((x @ normal.T - height[:, None]) < 1e-3).any(-1, keepdims=True)
        x = np.where(below, x / 2, x)
    step = rng.normal(size=x.shape) * 10 ** rng.uniform(-3, 0.5, (2, VERTICES, 1))
    given = {"x": x, "step": step, "normal": normal[None], "height": height, "dhat": np.full((1, len(normal)), DHAT)}
    return {k: torch.from_numpy(v.copy()) for k, v in given.items()}


def leaves(given: dict[str, Tensor]) -> dict[str, Tensor]:
    return {k: v.clone().requires_grad_() for k, v in given.items()}


def packed(a: dict[str, Tensor]) -> Tensor:
    """Data of the planes for the kernels; kappa and damping do not matter to a start."""
    shape = (a["height"].shape[0], *a["normal"].shape[1:2])
    zero = a["height"].new_zeros(shape)
    scalars = torch.stack([a["height"].expand(shape), zero, a["dhat"].expand(shape), zero], -1)
    return torch.cat([a["normal"].expand(*shape, 3), scalars], -1).reshape(shape[0], -1)


def by_begin(a: dict[str, Tensor]) -> Tensor:
    """The beginning of a step of 1 s from x with velocity `step`, of vertices that are in no body."""
    x, none = a["x"].contiguous(), a["x"].new_empty((0,))
    vertices, planes = x.shape[1], packed(a)
    empty, one = torch.empty(0, dtype=torch.int32), torch.zeros(1, dtype=torch.int32)
    tets = torch.empty((0, 5), dtype=torch.int32)
    bodies = Bodies(empty, one, torch.empty(0, dtype=torch.float64), tets, one, (0, 0, 0, 0))
    others = OtherBodies(torch.full((vertices,), -1, dtype=torch.int32), empty, one, tets, one, (0, 0, 0, 0))
    step = a["step"].expand_as(x).contiguous()
    start, _ = begin(x, step, x.new_zeros((1, 1, 3)), none, x.new_ones((1, vertices)), planes, none, none, none, none,
                     torch.zeros(vertices, dtype=torch.bool), bodies, others, (planes.shape[1], 0), 1.0, LOOKBACK,
                     start="inertia", filters=True, parts=False)  # fmt: skip
    return start - x


def by_reference(a: dict[str, Tensor]) -> Tensor:
    floor = object.__new__(FloorBarrier)
    floor.normal, floor.height = a["normal"][..., None], a["height"][..., None]
    floor.dhat = a["dhat"][..., None]
    return floor.start(a["x"].mT, a["step"].mT).mT


CODES = {"begin": by_begin, "reference": by_reference}


def limits(given: dict[str, Tensor]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps [n, 3], normals [P, 3], and how far each step may approach each plane [n, P]."""
    normal = given["normal"][0].numpy()
    gap = given["x"].numpy() @ normal.T - given["height"].numpy()[:, None]
    return given["step"].reshape(-1, 3).numpy(), normal, FILTER_ETA * np.maximum(gap - DHAT, 0).reshape(-1, len(normal))


def closest(step: np.ndarray, normal: np.ndarray, room: np.ndarray) -> np.ndarray:
    """The admitted motion closest to one step: the best of the projections on all sets of up to three planes."""
    best = np.zeros(3)
    for size in range(4):
        for which in map(list, itertools.combinations(range(len(normal)), size)):
            n = normal[which]
            if np.linalg.matrix_rank(n, 1e-9) < size:
                continue
            s = step - np.linalg.pinv(n) @ (n @ step + room[which]) if size else step
            if (normal @ s >= -room - 1e-12).all() and np.linalg.norm(s - step) < np.linalg.norm(best - step):
                best = s
    return best


@pytest.mark.parametrize("name", PLANES)
def test_no_start_goes_where_it_may_not(name: str) -> None:
    given = inputs(name)
    step, normal, room = limits(given)
    out = by_begin(given).reshape(-1, 3).numpy()
    size = np.linalg.norm(step, axis=1)
    assert (out @ normal.T >= -room - tolerance("cancelling") * size[:, None]).all()
    assert (np.linalg.norm(out, axis=1) <= (1 + tolerance("parallel_planes")) * size).all()
    admitted = (step @ normal.T >= -room).all(1)
    assert 20 < admitted.sum() < len(step) - 20
    assert np.abs(out - step)[admitted].max() <= tolerance("formula") * np.abs(step).max()
    within = (room == 0) & (step @ normal.T < 0)
    assert within.any(0).all(), "vertices within dhat of every plane that want to approach it"


@pytest.mark.parametrize("name", ("floor", "tilted", "valley", "narrow", "ridge", "corner"))
def test_it_is_the_closest_admitted_motion(name: str) -> None:
    given = inputs(name)
    step, normal, room = limits(given)
    out = by_begin(given).reshape(-1, 3).numpy()
    expected = np.array([closest(s, normal, r) for s, r in zip(step, room, strict=True)])
    assert np.abs(out - expected).max() <= tolerance("cancelling") * np.abs(step).max()
    assert (np.linalg.norm(expected - step, axis=1) > 1e-3).sum() > 50


def test_sliding_stays() -> None:
    given = inputs("tilted")
    step, normal, _ = limits(given)
    out = by_begin(given).reshape(-1, 3).numpy()
    across = (out - step) - ((out - step) @ normal[0])[:, None] * normal[0]
    assert np.abs(across).max() <= tolerance("formula") * np.abs(step).max()


def test_it_is_continuous_where_a_vertex_leaves_dhat() -> None:
    """A rule that lets what is just outside go to a tenth of its gap would raise its barrier from nothing."""
    n, at = (
        torch.eye(3, dtype=torch.float64)[None, 1:2],
        torch.tensor([[DHAT - 1e-9, DHAT + 1e-9]], dtype=torch.float64),
    )
    x = torch.stack([torch.zeros_like(at), at, torch.zeros_like(at)], -1)
    step = torch.tensor([0.3, -1.0, 0.1], dtype=torch.float64).expand_as(x)
    zero, dhat = torch.zeros_like(n[..., 0]), torch.full_like(n[..., 0], DHAT)
    given = {"x": x, "step": step, "normal": n, "height": zero, "dhat": dhat}
    inside, outside = (by_begin(given) + x)[0]
    assert (
        (inside - outside).abs().max() < tolerance("continuous")
        and abs(inside[1] - DHAT) < tolerance("continuous")
        and outside[0] == 0.3
    )


@pytest.mark.parametrize("name", PLANES)
def test_codes_agree(name: str) -> None:
    given = inputs(name)
    weight = torch.from_numpy(generator("weight", name).normal(size=tuple(given["x"].shape)))
    results = {}
    for code, run in CODES.items():
        a = leaves(given)
        out = run(a)
        results[code] = {"out": out.detach(), **dict(zip(a, torch.autograd.grad((weight * out).sum(), list(a.values())),
                                                         strict=True))}  # fmt: skip
    for key, expected in results["reference"].items():
        assert expected.abs().max() > 0, key
        assert relative_error(results["begin"][key], expected) <= tolerance("adjoint"), key


@pytest.mark.parametrize("name", PLANES)
def test_gradients_are_those_of_differences(name: str) -> None:
    given = inputs(name)
    rng = generator("direction", name)
    weight = torch.from_numpy(rng.normal(size=tuple(given["x"].shape)))
    for key in given:
        a = leaves(given)
        (grad,) = torch.autograd.grad((weight * by_begin(a)).sum(), a[key])
        direction = torch.from_numpy(rng.normal(size=tuple(a[key].shape)))
        size = 1e-7
        values = [
            (weight * by_begin({**given, key: given[key] + sign * size * direction})).sum() for sign in (1.0, -1.0)
        ]
        expected = float(values[0] - values[1]) / (2 * size)
        assert abs(float((grad * direction).sum()) - expected) <= tolerance("finite_difference") * abs(expected), key
