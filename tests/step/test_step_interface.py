"""The step's arguments: broadcasting, shapes of gradients, what leaves no tape, tapes without autograd, energies."""

import copy
import io
import pickle
import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bad_input import STEP as BAD_STEP
from helpers.bad_input import model_of, raises
from helpers.results import evaluated, saved_bytes
from helpers.two_boxes import STEP as CONTACT_STEP
from helpers.two_boxes import two_boxes
from helpers.values import STEP, uniform
from torch import Tensor

import diffvbd as dv
from diffvbd import results
from diffvbd._common.checks import name_value
from diffvbd.testing import build_scene, relative_error, tolerance

GROUND = {"height": -0.06, "kappa": 2e4, "dhat": 0.1, "damping": 20.0}


def beam_model(device: str, **options: Any) -> dv.Model:
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(**GROUND), dv.Anchor(50.0))
    return dv.Model(dv.mesh.box((3, 2, 2)), **{"pinned": [0, 1], "energies": energies, **options}, device=device)


def state(model: dv.Model, *lead: int) -> tuple[Tensor, Tensor]:
    shape = (*lead, model.num_vertices, 3)
    x, v = uniform(*shape, low=-0.03, high=0.03), uniform(*shape, low=-1.0, high=0.5)
    return model.rest_points + x.to(model.device), v.to(model.device)


def total(x: Tensor, v: Tensor) -> Tensor:
    weights = uniform(*x.shape).to(x.device)
    return (weights * (x.square() + 0.01 * v.square())).sum()


# Name of an argument, its own shape (letters: V vertices, T tets) and its size.
OWN = {
    "mu": ("T", 1e4),
    "lam": ("T", 1e4),
    "density": ("T", 1e3),
    "force": ("V3", 5.0),
    "gravity": ("13", 5.0),
    "prescribed": ("V3", 0.1),
    "rest_points": ("V3", 0.05),
    "floor_kappa": ("", 2e4),
    "floor_dhat": ("", 0.1),
    "floor_damping": ("", 20.0),
    "floor_height": ("1", -0.06),
    "floor_normal": ("13", 1.0),
    "anchor_stiffness": ("V", 50.0),
    "anchor_points": ("V3", 0.1),
}


def own_shape(model: dv.Model, name: str) -> tuple[int, ...]:
    sizes = {"V": model.num_vertices, "T": model.num_tets}
    return tuple(sizes.get(letter) or int(letter) for letter in OWN[name][0])


def value_of(model: dv.Model, name: str, shape: tuple[int, ...]) -> Tensor:
    value = OWN[name][1] * uniform(*shape).to(model.device)
    if name in ("prescribed", "rest_points", "anchor_points") and shape[-2:] == (model.num_vertices, 3):
        value = value + model.rest_points
    if name == "prescribed" and shape[-2:] == (model.num_vertices, 3):
        value = torch.where(model.pinned[:, None], value, torch.nan)
    if name == "floor_normal":
        value = 0.1 * value + torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64, device=model.device)
    return value


def broadcast_cases() -> list[tuple[str, tuple[int, ...], str]]:
    """(argument, leading shape of x, shape of the value, in which 'own' stands for the argument's own shape)."""
    cases = []
    for name in OWN:
        cases += [(name, (), "own"), (name, (3,), "own"), (name, (3,), "3,own"), (name, (2, 3), "2,3,own")]
        cases += [(name, (2, 3), "3,own"), (name, (2, 3), "2,1,own"), (name, (1,), "own"), (name, (3,), "1,own")]
        if name in ("mu", "lam", "density"):
            cases += [(name, (3,), "3,1"), (name, (2, 3), "2,1,1"), (name, (3,), ""), (name, (2, 3), "1")]
    return cases


@pytest.mark.parametrize(("name", "lead", "spec"), broadcast_cases())
def test_broadcasting_equals_a_loop_over_scenes(
    device: str, one_regime: None, name: str, lead: tuple[int, ...], spec: str
) -> None:
    model = beam_model(device)
    own = own_shape(model, name)
    shape = tuple(n for part in spec.split(",") if part for n in (own if part == "own" else (int(part),)))
    value = value_of(model, name, shape).requires_grad_()
    # the value that each scene sees, by torch's own broadcasting
    full = value.expand((*lead, *(own if spec.endswith("own") else (model.num_tets,))))
    x, v = state(model, *lead)

    def run(x: Tensor, v: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        return dv.step(model, x, v, **{"mu": 1e4, "lam": 2e4, **STEP, name: value})

    actual = run(x, v, value)
    scenes = list(np.ndindex(*lead))
    expected = [run(x[i], v[i], full[i]) for i in scenes]
    for k in range(2):
        assert actual[k].shape == x.shape
        assert torch.equal(actual[k], torch.stack([e[k] for e in expected]).reshape(x.shape))
    (slope,) = torch.autograd.grad(total(*actual), value)
    looped = total(*(torch.stack([e[k] for e in expected]).reshape(x.shape) for k in range(2)))
    (expected_slope,) = torch.autograd.grad(looped, value)
    assert slope.shape == value.shape
    assert expected_slope.abs().max() > 0
    assert relative_error(slope, expected_slope) <= tolerance("cancelling")


def test_python_numbers_mean_constant_tensors(device: str) -> None:
    model = beam_model(device)
    x, v = state(model, 2)
    numbers = {"mu": 1e4, "lam": 2e4, "density": 900.0}
    tensors = {k: torch.tensor(a, dtype=torch.float64, device=device) for k, a in numbers.items()}
    kappa = {"floor_kappa": 1e4}
    actual = dv.step(model, x, v, **numbers, gravity=np.array([0.0, -5.0, 1.0]), **kappa, **STEP)
    kappa = {"floor_kappa": torch.tensor(1e4, dtype=torch.float64, device=device)}
    gravity = torch.tensor([0.0, -5.0, 1.0], dtype=torch.float64, device=device)
    expected = dv.step(model, x, v, **tensors, gravity=gravity, **kappa, **STEP)
    assert torch.equal(actual[0], expected[0]) and torch.equal(actual[1], expected[1])


def test_defaults_are_the_models_own_values(device: str) -> None:
    mesh = dv.mesh.box((3, 2, 2))
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(**GROUND))
    model = dv.Model(mesh, density=700.0, pinned=[0], energies=energies, device=device)
    x, v = state(model)
    plain = dv.step(model, x, v, mu=1e4, lam=2e4, **STEP)
    options = {"force": torch.zeros_like(x), "gravity": (0.0, -9.81, 0.0), "prescribed": x, "density": 700.0}
    options |= {"rest_points": model.rest_points, "floor_kappa": 2e4}
    spelled = dv.step(model, x, v, mu=1e4, lam=2e4, **options, **STEP)
    for a, b in zip(spelled, plain, strict=True):
        assert relative_error(a, b) <= tolerance("sum")
    moved = dv.step(model, x, v, mu=1e4, lam=2e4, prescribed=torch.where(model.pinned[:, None], x + 0.01, x), **STEP)
    assert torch.equal(moved[0][0], x[0] + 0.01)
    assert torch.isfinite(moved[0]).all() and (moved[0][1:] - plain[0][1:]).abs().max() > 1e-6


def same(a: Tensor, b: Tensor) -> bool:
    """To the bit, NaN included: it stands where `prescribed` is not read."""
    return torch.equal(a.nan_to_num(nan=1e99), b.nan_to_num(nan=1e99))


def test_inputs_are_untouched_and_steps_repeat(device: str) -> None:
    scene = build_scene("floor_damped")
    model, inputs = scene.model(device), scene.inputs(device=device)
    constants = {k: t.clone() for k, t in vars(model).items() if isinstance(t, Tensor)}
    before = {k: t.clone() for k, t in inputs.items()}
    results = [evaluated(model, inputs, scene.solver(4)) for _ in range(2)]
    assert all(same(inputs[k], before[k]) for k in inputs)
    assert all(torch.equal(getattr(model, k), constants[k]) for k in constants)
    assert results[0].keys() == results[1].keys()
    assert all(torch.equal(results[0][k], results[1][k]) for k in results[0])


# --- what requires no grad leaves no tape -----------------------------------------------------------------------------


def test_without_grad_nothing_is_saved(device: str) -> None:
    model = beam_model(device)
    x, v = state(model)
    assert saved_bytes(lambda: dv.step(model, x, v, mu=1e4, lam=2e4, density=900.0, **STEP)) == 0
    mu = torch.tensor(1e4, dtype=torch.float64, device=device, requires_grad=True)
    with torch.no_grad():
        assert saved_bytes(lambda: dv.step(model, x, v, mu=mu, lam=2e4, **STEP)) == 0
    step = dv.step(model, x, v, mu=1e4, lam=2e4, **STEP)
    assert not step[0].requires_grad and not step[1].requires_grad


def test_a_tape_exists_only_for_steps_that_need_one(device: str) -> None:
    """Velocity alone: the tape; with recompute: no tape; through the last of two steps only: one tape."""
    model = beam_model(device, energies=(dv.StableNeoHookean(),))
    x, v = state(model)
    leaf = v.clone().requires_grad_()
    sweeps = 20
    full = sweeps * model.num_active * 72

    def run(first: Tensor, second: Tensor, tape: str) -> Tensor:
        solver, at = dv.VBD(0.01, sweeps, tape=tape), x
        for velocity in (first, second):
            at, _ = dv.step(model, at, velocity, solver, mu=1e4, lam=2e4)
        return at

    own = [t for t in vars(model).values() if isinstance(t, Tensor)]
    once = saved_bytes(lambda: run(v, leaf, "full"), own)
    twice = saved_bytes(lambda: run(leaf, leaf, "full"), own)
    nothing = saved_bytes(lambda: run(leaf, leaf, "recompute"), own)
    assert full <= once < 1.5 * full
    assert 2 * full <= twice < 2.5 * full
    assert nothing < 0.5 * full


# --- tapes without autograd -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", ["plain", "paper", "floor_damped", "anchored", "batch"])
def test_step_forward_and_backward_equal_autograd(device: str, case: str) -> None:
    scene = build_scene(case)
    model, inputs = scene.model(device), scene.inputs(device=device)
    leaves = {k: t.clone().requires_grad_() for k, t in inputs.items()}
    out = dv.step(model, solver=scene.solver(3), **leaves)
    grad_x, grad_v = (uniform(*t.shape, low=-1.0, high=1.0).to(device) for t in out)
    expected = torch.autograd.grad(out, list(leaves.values()), (grad_x, grad_v), allow_unused=True, retain_graph=True)
    of_x = torch.autograd.grad(out[0], list(leaves.values()), grad_x, allow_unused=True)
    with torch.no_grad():
        x, v, tape = dv.step_forward(model, solver=scene.solver(3), wrt=tuple(leaves), **inputs)
        assert torch.equal(x, out[0]) and torch.equal(v, out[1])
        assert not x.requires_grad and not v.requires_grad
        for _ in range(2):
            grads = dv.step_backward(tape, grad_x, grad_v)
            assert list(grads) == list(leaves)
            for (name, leaf), slope in zip(leaves.items(), expected, strict=True):
                assert grads[name].shape == leaf.shape
                assert torch.equal(grads[name], torch.zeros_like(leaf) if slope is None else slope), name
        for name, slope in zip(leaves, of_x, strict=True):
            assert slope is None or torch.equal(dv.step_backward(tape, grad_x)[name], slope), name
    assert sum(float(g.abs().max()) > 0 for g in grads.values()) >= 5
    assert not any(t.requires_grad for t in inputs.values())


def test_step_forward_keeps_a_tape_for_wrt_only(device: str) -> None:
    model = beam_model(device, energies=(dv.StableNeoHookean(),))
    x, v = state(model)
    _, _, tape = dv.step_forward(model, x, v, mu=1e4, lam=2e4, **STEP)
    assert set(dv.step_backward(tape, torch.ones_like(x))) == {"x", "v"}
    _, _, tape = dv.step_forward(model, x, v, mu=1e4, lam=2e4, wrt=("mu", "rest_points", "density"), **STEP)
    grads = dv.step_backward(tape, torch.ones_like(x))
    assert {k: tuple(t.shape) for k, t in grads.items()} == {
        "mu": (), "rest_points": (model.num_vertices, 3), "density": (model.num_tets,)}  # fmt: skip
    assert all(t.abs().max() > 0 for t in grads.values())
    zero = dv.step_backward(tape)
    assert all(torch.equal(zero[k], torch.zeros_like(t)) for k, t in grads.items())
    assert saved_bytes(lambda: dv.step_forward(model, x, v, mu=1e4, lam=2e4, wrt=(), **STEP)) == 0
    with pytest.raises(ValueError, match="grad_x.*got"):
        dv.step_backward(tape, torch.ones(2, 3, dtype=torch.float64, device=device))
    with pytest.raises((ValueError, TypeError), match="wrt.*force"):
        dv.step_forward(model, x, v, mu=1e4, lam=2e4, wrt=("force",), **STEP)
    with pytest.raises((ValueError, TypeError), match="wrt.*x, v, mu.*stiffness"):
        dv.step_forward(model, x, v, mu=1e4, lam=2e4, wrt=("stiffness",), **STEP)
    with pytest.raises(ValueError, match="wrt.*'viscosty', which is not given: is 'viscosity' meant"):
        dv.step_forward(model, x, v, mu=1e4, lam=2e4, wrt=("viscosty",), **STEP)


# --- check_gradients --------------------------------------------------------------------------------------------------


def test_check_gradients_names_what_the_loss_must_take_and_return() -> None:
    given = {"mu": torch.ones((), dtype=torch.float64)}
    with pytest.raises(TypeError, match="loss: expected a function of mu: .*'m'"):
        dv.check_gradients(lambda m: m, given)
    with pytest.raises(TypeError, match="loss: expected a function that returns a scalar tensor, got float"):
        dv.check_gradients(lambda mu: mu.item(), given)
    for loss in (lambda mu: torch.ones(()), lambda mu: mu.detach(), lambda mu: (mu > 0).sum()):
        with pytest.raises(ValueError, match="loss: expected a scalar with the graph of its arguments, got one that"):
            dv.check_gradients(loss, given)
    with pytest.raises(ValueError, match="loss: expected a scalar with the graph of its arguments, got one that"):
        dv.check_gradients(lambda: torch.ones(()), {})
    for bad, message in (
        ({"loss": None}, "loss: expected a function of mu, got NoneType"),
        ({"arguments": {1: given["mu"]}}, r"arguments: expected a dict of tensors by name, got the keys \[1\]"),
        ({"relative_steps": []}, "relative_steps: expected a sequence of numbers > 0"),
        ({"relative_steps": [0.0]}, "relative_steps: expected a finite number > 0"),
        ({"tolerance": None}, "tolerance: expected a number, got NoneType"),
        ({"seed": "a"}, "seed: expected an integer, got str"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            dv.check_gradients(**{"loss": lambda mu: mu.square(), "arguments": given, **bad})  # pyright: ignore


class WrongBackward(torch.autograd.Function):
    """The identity with a gradient that is 1 % too large."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return 1.01 * grads[0]


class NoNumber(WrongBackward):
    """The identity with a gradient that is no number."""

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return float("nan") * grads[0]


def test_check_gradients_of_what_is_no_number_fails() -> None:
    given = {"a": torch.ones(3, dtype=torch.float64)}
    assert dv.check_gradients(lambda a: a.sum(), given, verbose=False).ok
    assert not dv.check_gradients(lambda a: NoNumber.apply(a).sum(), given, verbose=False).ok
    assert not dv.check_gradients(lambda a: a.sum() + float("nan"), given, verbose=False).ok


def test_check_gradients_tells_right_from_wrong(device: str, capsys: pytest.CaptureFixture[str]) -> None:
    scene = build_scene("anchored")
    model, inputs = scene.model(device), scene.inputs(device=device)
    arguments = {k: inputs[k] for k in ("x", "v", "mu", "lam", "force", "rest_points", "density")}
    rest = {k: value for k, value in inputs.items() if k not in arguments}

    def loss(**given: Tensor) -> Tensor:
        return total(*dv.step(model, solver=scene.solver(3), **given, **rest))

    right = dv.check_gradients(loss, arguments)
    assert right.ok, str(right)
    assert [row[0] for row in right.rows] == list(arguments)
    assert all(row[1] > 0 for row in right.rows)
    assert "mu" in capsys.readouterr().out
    wrong = dv.check_gradients(lambda **a: loss(**(a | {"mu": WrongBackward.apply(a["mu"])})), arguments, verbose=False)
    assert not wrong.ok
    assert [row[0] for row in wrong.rows if row[4] > wrong.tolerance] == ["mu"]
    assert capsys.readouterr().out == "" and "above tolerance" in str(wrong)
    with pytest.raises(ValueError, match="x.*float32"):
        dv.check_gradients(loss, {"x": arguments["x"].float()})
    with pytest.raises(ValueError, match="loss.*scalar"):
        dv.check_gradients(lambda x: x, {"x": arguments["x"]})


# --- vertex energies end to end ---------------------------------------------------------------------------------------


def test_anchor_pulls_chosen_vertices_to_their_points(device: str) -> None:
    """A free vertex without elastic energy is a damped spring: implicit Euler has a closed form."""
    mesh = dv.mesh.cube()
    points = torch.from_numpy(mesh.points.copy()) + 0.1
    k, h = 30.0, 0.02
    model = dv.Model(mesh, density=6.0, energies=(dv.Anchor(k, points=points, vertices=[2, 5]),), device=device)
    x, v = state(model)
    new, speed = dv.step(model, x, v, dv.VBD(h, 1), gravity=(0.0, 0.0, 0.0))
    m = model.mass[:, None]
    y = x + h * v
    chosen = torch.zeros(8, 1, dtype=torch.bool).index_fill(0, torch.tensor([2, 5]), True)
    chosen, points = chosen.to(device), points.to(device)
    expected = torch.where(chosen, (m * y + h * h * k * points) / (m + h * h * k), y)
    assert relative_error(new, expected) <= tolerance("formula")
    assert relative_error(speed, (expected - x) / h) <= tolerance("cancelling")
    by_mask = dv.Model(mesh, density=6.0, energies=(dv.Anchor(k, points=points, vertices=chosen[:, 0]),), device=device)
    assert torch.equal(dv.step(by_mask, x, v, dv.VBD(h, 1), gravity=(0, 0, 0))[0], new)
    stiffness = torch.full((8,), k, dtype=torch.float64, device=device, requires_grad=True)
    out = dv.step(model, x, v, dv.VBD(h, 1), anchor_stiffness=stiffness, gravity=(0.0, 0.0, 0.0))
    (slope,) = torch.autograd.grad(out[0].sum(), stiffness)
    formula = (h * h * m * (points - y) / (m + h * h * k) ** 2).sum(-1) * chosen[:, 0]
    assert relative_error(slope, formula) <= tolerance("cancelling")


# --- tapes ------------------------------------------------------------------------------------------------------------


def forward(device: str, **options: Any) -> tuple[Tensor, results.Tape]:
    model = model_of(device)
    x, _, tape = dv.step_forward(model, model.rest_points, 0 * model.rest_points, **BAD_STEP | options)
    return x, tape


@pytest.mark.parametrize(
    "store",
    [pickle.dumps, copy.deepcopy, copy.copy, lambda tape: torch.save(tape, io.BytesIO())],
    ids=["pickle", "deepcopy", "copy", "save"],
)
def test_a_tape_is_not_stored_or_copied(device: str, store: Callable[[results.Tape], Any]) -> None:
    x, tape = forward(device)
    with pytest.raises(TypeError, match="Keep the states .* and run step_forward again"):
        store(tape)
    with pytest.raises(TypeError, match="Tape: expected"):
        store({"tapes": [tape]}) if store is not copy.copy else store(tape)  # pyright: ignore[reportArgumentType]
    assert dv.step_backward(tape, torch.ones_like(x))["x"].any()  # this one still works


def test_a_tape_without_a_graph_is_refused(device: str) -> None:
    x, tape = forward(device)
    lost = results.Tape(tape.inputs, (tape.outputs[0].detach(), tape.outputs[1].detach()))
    for grads in ((torch.ones_like(x),), ()):
        with pytest.raises(RuntimeError, match="tape: expected one with the graph.*run step_forward again"):
            dv.step_backward(lost, *grads)


def test_steps_that_move_with_nothing_have_gradients_of_zero(device: str) -> None:
    """Without sweeps the material is read by nobody, and without wrt there is no gradient to give."""
    x, tape = forward(device, wrt=("mu",), solver=dv.VBD(0.01, 0))
    assert torch.equal(dv.step_backward(tape, torch.ones_like(x))["mu"], torch.zeros_like(x[0, 0]))
    x, tape = forward(device, wrt=())
    assert dv.step_backward(tape, torch.ones_like(x)) == {}


@pytest.mark.parametrize("name", ["grad_x", "grad_v"])
def test_adjoints_are_like_the_states(device: str, name: str) -> None:
    x, tape = forward(device)
    one = torch.ones_like(x)
    nested = torch.nested.as_nested_tensor([one, one])
    for bad, got in [
        (1.0, "float"), ([1.0], "list"), (one.cpu().numpy(), "ndarray"), (one.float(), "float32"),
        (one.to("meta"), "meta"), (one.to_sparse(), "sparse_coo"), (nested, "nested"), (one[None], r"\[1, 8, 3\]"),
        (one[0, 0], r"\[\]"),
    ]:  # fmt: skip
        raises(lambda bad=bad: dv.step_backward(tape, **{name: bad}), name, got)
    assert dv.step_backward(tape, **{name: one})["x"].any()


@pytest.mark.parametrize("tape", [None, {}, (1, 2), torch.ones(8, 3)])
def test_only_a_tape_is_a_tape(tape: Any) -> None:
    raises(lambda: dv.step_backward(tape, torch.ones(8, 3)), "tape", type(tape).__name__)


def test_a_bad_value_that_requires_grad_is_named_without_a_warning() -> None:
    value = torch.tensor([1.0, -2.5], dtype=torch.float64, requires_grad=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        raises(lambda: name_value("mass", "numbers > 0", value, value > 0), "mass", re.escape("-2.5 at [1]"))


@pytest.mark.parametrize("options", [{}, {"detections": 2}])
@pytest.mark.parametrize("kind", ["is_grads_batched", "vmap"])
def test_batched_gradients_of_a_step_with_contact_say_so(device: str, options: dict[str, Any], kind: str) -> None:
    model = two_boxes(device, **options)
    x = model.rest_points.clone().requires_grad_()
    for out in dv.step(model, x, torch.zeros_like(x), **CONTACT_STEP):
        rows = torch.ones((2, *x.shape), dtype=x.dtype, device=device)
        with pytest.raises(NotImplementedError, match="batched gradients .* of a step with contact are not supported"):
            if kind == "vmap":
                torch.func.vmap(lambda row, out=out: torch.autograd.grad(out, x, row, retain_graph=True)[0])(rows)
            else:
                torch.autograd.grad(out, x, rows, is_grads_batched=True, retain_graph=True)
        assert torch.autograd.grad(out, x, rows[0], retain_graph=True)[0].any()
