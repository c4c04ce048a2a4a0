"""Claim: the raw operators refuse what their loops would read out of bounds: tensors that are missing, too small, of
another kind or in another place, and settings that no step has. What indices hold they do not look at."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from helpers.two_boxes import ball
from helpers.values import STEP
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import diffvbd as dv
from diffvbd import ops
from diffvbd.adjoint.contact_lag import Pairs, pair_lag

CONTACT = (
    "contact_motion",
    "contact_translation",
    "contact_above_floor",
    "contact_start",
    "contact_lag",
    "contact_rubbing",
    "contact_unsupported",
)
NAMES = {
    "floor": ("sweep", "begin", "rigid"),
    "pinned": ("sweep", "begin"),
    "contact": ("sweep", "begin", *CONTACT),
}
CASES = [(scene, name + end) for scene, names in NAMES.items() for name in names for end in ("", "_backward")]
CASES += [
    ("contact", "contact_lowest"),
    ("contact", "contact_advance"),
    ("contact", "contact_narrow"),
    ("contact", "contact_frames"),
    ("contact", "contact_bends"),
    ("contact", "contact_held_up"),
    ("contact", "contact_falls"),
    ("contact", "contact_keep"),
    ("contact", "contact_sweep_rooms"),
    ("contact", "contact_rooms"),
    ("contact", "contact_rigid_system"),
    ("contact", "contact_rigid_move"),
    ("contact", "contact_rigid_reverse"),
    ("floor", "pack_rest"),
    ("floor", "star_sum"),
    ("floor", "tet_gather"),
]
# what an operator takes and does not read, or of which it needs a part
UNREAD = {
    "sweep_backward": {"x_start"},
    "begin": {"order", "other_order"},
    "contact_keep": {"ptr"},
    "begin_backward": {"order", "tets", "other_order", "other_tets"},
    "rigid": {"order"},
    "rigid_backward": {"order"},
    "star_sum": {"star_ptr", "star"},
}
OF_CHOICE = {"mu", "lam", "rest", "other_tets"}  # between starts, which this scene does not have
SHARED = ("mu", "lam", "kappa")  # one value for all is legal
# Empty where a scene lacks them; which it does, no tensor can tell.
OPTIONAL = ("planes", "alone", "floor_lag", "lag", "own_room", "v_bar", "friction", "damping", "lag_bar", "push_bar")
EMPTY_OF = {
    ("begin", "rest"),
    ("contact_above_floor", "u"),
    ("contact_above_floor_backward", "u"),
    ("contact_motion", "fall"),
    ("contact_rooms", "floor"),
}
ONE_KIND = ("pack_rest", "star_sum", "tet_gather", "contact_keep")  # with one floating tensor, which may be either
ERRORS = (ValueError, RuntimeError)


class Calls(TorchDispatchMode):
    """The arguments of the last call of each operator, by their names."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[str, dict[str, Any]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.namespace == "diffvbd":
            names = [a.name for a in func._schema.arguments]
            self.seen[func._opname] = dict(zip(names, args, strict=True))
        return func(*args, **(kwargs or {}))


def model_of(scene: str, device: str) -> dv.Model:
    if scene == "contact":
        energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.01), dv.PairBarrier(dhat=0.02, damping=1.0),
                    dv.Friction(0.4, 0.05))  # fmt: skip
        boxes = [dv.mesh.box(2, 0.2), dv.mesh.box(2, 0.2).translate((0.02, 0.208, 0.03))]
        return dv.Model(dv.mesh.join(boxes), energies=energies, colliders=[ball()], device=device)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.5, damping=1.0), dv.Anchor(1.0))
    return dv.Model(dv.mesh.cube(3), pinned=[0] if scene == "pinned" else None, energies=energies, device=device)


@pytest.fixture(scope="module")
def recorded() -> Iterator[Callable[[str, str], dict[str, dict[str, Any]]]]:
    """Calls of a step of a scene and of its backward, two scenes at once."""
    known: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}

    def of(scene: str, device: str) -> dict[str, dict[str, Any]]:
        if (scene, device) not in known:
            model = model_of(scene, device)
            with Calls() as calls:
                x = torch.stack([model.rest_points] * 2).requires_grad_()
                rest = model.rest_points.clone().requires_grad_()
                out = dv.step(model, x, torch.zeros_like(x), mu=2e4, lam=4e4, rest_points=rest, density=1e3, **STEP)
                (out[0].sum() + out[1].sum()).backward()
                if "contact_rubbing" in calls.seen:  # what steps call only where potentials are compared
                    near = calls.seen["contact_rubbing"]
                    points, listed = near["x"].detach().requires_grad_(), Pairs(*(near[key] for key in Pairs._fields))
                    pair_lag(points, near["collider"], near["kappa"], near["origin"], listed).sum().backward()
            known[scene, device] = calls.seen
        return known[scene, device]

    yield of


def refused(name: str, given: dict[str, Any], **changes: Any) -> None:
    """The operator raises, and still runs with what it was given."""
    operator = getattr(torch.ops.diffvbd, name)
    with pytest.raises(ERRORS) as error:
        operator(*(given | changes).values())
    assert "expected" in str(error.value) or "shorter" in str(error.value), (list(changes), str(error.value))


def tensors(scene: str, name: str, given: dict[str, Any]) -> Iterator[tuple[str, Tensor]]:
    """Those that the operator was given and reads."""
    unread = UNREAD.get(name, set()) | (OF_CHOICE if name == "begin" and scene == "contact" else set())
    for key, value in given.items():
        if isinstance(value, Tensor) and value.numel() and key not in unread:
            yield key, value


@pytest.mark.parametrize(("scene", "name"), CASES)
def test_tensors_that_are_missing_or_too_small(device: str, recorded: Any, scene: str, name: str) -> None:
    given = recorded(scene, device)[name]
    wrong = []
    for key, value in tensors(scene, name, given):
        if key in ("held", "body", "values"):  # of which the vertices are a part; whose shape is its own
            continue
        few = [value.reshape(-1)[:-1].clone()]
        few += [value.new_empty((0,))] if key not in OPTIONAL and (name, key) not in EMPTY_OF else []
        few += [value.reshape(-1)[:1].reshape(1, 1).clone()] if key not in SHARED else []
        for changed in few:
            absent = key in OPTIONAL and not changed.numel()
            if changed.numel() != value.numel() and not absent:
                wrong += attempt(name, given, key, changed)
    assert not wrong


def attempt(name: str, given: dict[str, Any], key: str, value: Tensor) -> list[str]:
    """What the operator has not refused."""
    try:
        refused(name, given, **{key: value})
    except pytest.fail.Exception:
        return [f"{key} {list(value.shape)} {value.dtype} {value.device}"]
    return []


@pytest.mark.parametrize(("scene", "name"), CASES)
def test_tensors_of_another_kind_or_place(device: str, recorded: Any, scene: str, name: str) -> None:
    given = recorded(scene, device)[name]
    wrong = []
    for key, value in tensors(scene, name, given):
        if value.is_floating_point():
            other = value.float() if value.dtype == torch.float64 else value.double()
        else:
            other = value.to(torch.int64 if value.dtype != torch.int64 else torch.int32)
        alone = sum(isinstance(v, Tensor) and v.numel() > 0 for v in given.values()) == 1
        if not (
            alone or key in ("x", "values", "rest", "constants") and value.is_floating_point() and name in ONE_KIND
        ):
            wrong += attempt(name, given, key, other)
        if not alone:
            wrong += attempt(name, given, key, value.to("meta"))
            wrong += attempt(name, given, key, value.cpu()) if value.is_cuda else []
    assert not wrong


def test_corrections_of_which_some_is_missing(device: str, recorded: Any) -> None:
    given = recorded("contact", device)["contact_rigid_reverse"]
    lists = {key: value for key, value in given.items() if isinstance(value, list) and isinstance(value[0], Tensor)}
    assert set(lists) == {"at", "motion", "share", "factor", "groups"}
    refused("contact_rigid_reverse", given, **dict.fromkeys(lists, []))
    for key, value in lists.items():
        refused("contact_rigid_reverse", given, **{key: [*value, value[0]]})
        if value[0].numel():
            refused("contact_rigid_reverse", given, **{key: [t.reshape(-1)[:-1].clone() for t in value]})
            refused("contact_rigid_reverse", given, **{key: [t.to(torch.float16) for t in value]})
            refused("contact_rigid_reverse", given, **{key: [t.to("meta") for t in value]})
            if device != "cpu":
                refused("contact_rigid_reverse", given, **{key: [t.cpu() for t in value]})


@pytest.mark.parametrize("end", ["", "_backward"])
def test_settings_that_no_step_has(device: str, recorded: Any, end: str) -> None:
    name, given = "sweep" + end, recorded("floor", device)["sweep" + end]
    for policy in (-1, 3, 2**40) if not end else (-1, 0, 3, 2**40):
        refused(name, given, tape_policy=policy)
    for energies in (-1, 3 | given["energies"], 1 << 20, given["energies"] | 1 << 5, 1 << 40):
        refused(name, given, energies=energies)
    floor, anchor = given["data_count"]
    for count in ([floor], [floor, 1], [1, anchor], [-floor, anchor], [floor, 0], [0, anchor], [7 << 60, anchor]):
        refused(name, given, data_count=count)
    refused(name, given, numbers=given["numbers"][:-1])
    refused(name, given, sweeps=-1)


@pytest.mark.parametrize("name", ["sweep", "sweep_backward", "pack_rest"])
def test_a_plan_that_is_shorter_than_its_header_says(device: str, recorded: Any, name: str) -> None:
    given = recorded("floor", device)[name]
    for place in (4, 7):  # blocks, incoming slots
        for change in (1000, -1000):
            plan, sizes = given["plan"].clone(), list(given["sizes"])
            plan[place] += change
            if device == "cuda":
                sizes[ops.plan_sizes(torch.arange(ops.PLAN_HEADER + 8), "cuda").index(place)] += change
            refused(name, given, plan=plan, sizes=sizes)
    refused(name, given, plan=given["plan"][: ops.PLAN_HEADER].clone())


def test_a_scene_without_tets_or_energies_lacks_what_it_does_not_read(device: str) -> None:
    points = torch.rand((2, 5, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    cloud = dv.TetMesh(points[0].numpy(), torch.zeros((0, 4), dtype=torch.int64).numpy())
    for model in (
        dv.Model(cloud, pinned=range(5), device=device),
        dv.Model(dv.mesh.cube(), energies=(), device=device),
    ):
        x = model.rest_points
        end, _ = dv.step(model, x, torch.zeros_like(x), mu=1e4, lam=1e4, **STEP)
        assert end.shape == x.shape and torch.isfinite(end).all()
