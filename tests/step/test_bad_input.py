"""Bad input: a ValueError or TypeError that names the argument and says what came; inputs stay untouched.

Shapes, types and devices are checked always. Values are read on CUDA only inside debug_checks(), because a look at one
waits for the device: `value_checks` opens it there.
"""

import re
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bad_input import INF, MESH, NAN, STEP, doubles, model_of, ones, raises, spoiled
from torch import Tensor

import diffvbd as dv
from diffvbd.ops.regimes import regime
from diffvbd.testing import debug_checks, on_device

# --- arguments of a step ----------------------------------------------------------------------------------------------


ARGUMENTS: list[tuple[str, Any, str]] = [
    # shape
    ("x", ones(5, 3), r"\[5, 3\]"),
    ("x", ones(3), r"\[3\]"),
    ("x", ones(8, 2), r"\[8, 2\]"),
    ("v", ones(5, 3), r"\[5, 3\]"),
    ("v", ones(1, 8, 3), r"\[1, 8, 3\]"),
    ("mu", ones(5), r"\[5\]"),
    ("mu", ones(2, 6), r"\[2, 6\]"),
    ("lam", ones(6, 1), r"\[6, 1\]"),
    ("density", ones(8), r"\[8\]"),
    ("force", ones(8, 2), r"\[8, 2\]"),
    ("force", ones(2, 8, 3), r"\[2, 8, 3\]"),
    ("gravity", ones(2), r"\[2\]"),
    ("gravity", (0.0, 1.0), "2 numbers"),
    ("gravity", np.zeros(4), "4 numbers"),
    ("prescribed", ones(3, 3), r"\[3, 3\]"),
    ("rest_points", ones(4, 3), r"\[4, 3\]"),
    ("floor_height", ones(3), r"\[3\]"),
    ("floor_kappa", ones(2), r"\[2\]"),
    ("anchor_stiffness", ones(7), r"\[7\]"),
    ("anchor_points", ones(7, 3), r"\[7, 3\]"),
    # dtype
    *((name, ones(8, 3, dtype=torch.float32), "float32") for name in ("x", "v", "force", "prescribed", "rest_points")),
    ("x", ones(8, 3, dtype=torch.int64), "int64"),
    ("x", ones(8, 3, dtype=torch.complex128), "complex128"),
    ("mu", ones(6, dtype=torch.float32), "float32"),
    ("lam", ones(dtype=torch.int64), "int64"),
    ("density", ones(dtype=torch.float16), "float16"),
    ("gravity", ones(3, dtype=torch.float32), "float32"),
    ("anchor_stiffness", ones(dtype=torch.float32), "float32"),
    # device
    *((name, ones(8, 3).to("meta"), "meta") for name in ("x", "v", "force", "gravity", "prescribed", "rest_points")),
    *((name, ones(6).to("meta"), "meta") for name in ("mu", "lam", "density")),
    ("anchor_points", ones(8, 3).to("meta"), "meta"),
    # type
    ("x", [[0.0, 0.0, 0.0]] * 8, "list"),
    ("x", np.zeros((8, 3)), "ndarray"),
    ("v", None, "None"),
    ("mu", "soft", "str"),
    ("mu", None, "None"),
    ("mu", True, "bool"),
    ("mu", [1e4] * 6, "list"),
    ("lam", np.full(6, 1e4), "ndarray"),
    ("density", "heavy", "str"),
    ("force", [1.0, 2.0, 3.0], "list"),
    ("gravity", "off", "str|off"),
    ("gravity", -9.81, "float|9.81"),
    ("prescribed", "here", "str"),
    ("rest_points", MESH, "TetMesh"),
    ("floor_kappa", "stiff", "str"),
    ("adjoint", "full", "str|full"),
    # numbers that no float holds
    *((name, 10**400, "1329 bits") for name in ("mu", "lam", "density", "floor_kappa")),
    ("gravity", (0, -(10**400), 0), "1329 bits"),
    # not finite
    *((name, spoiled(bad, 3, 1), str(bad)) for name in ("x", "v", "force") for bad in (NAN, INF)),
    *((name, bad, str(bad)) for name in ("force", "prescribed") for bad in (NAN, INF, np.float32(NAN))),
    ("x", spoiled(NAN, 0, 0), "nan"),
    ("gravity", (0.0, NAN, 0.0), "nan"),
    ("gravity", doubles(0.0, INF, 0.0), "inf"),
    ("prescribed", spoiled(NAN, 0, 2), "nan"),
    ("rest_points", spoiled(NAN, 5, 0), "nan"),
    ("rest_points", spoiled(INF, 5, 0), "nan|inf"),
    *((name, bad, str(bad)) for name in ("mu", "lam", "density") for bad in (NAN, INF)),
    *((f"floor_{name}", NAN, "nan") for name in ("kappa", "dhat", "damping")),
    ("anchor_stiffness", NAN, "nan"),
    # range
    ("mu", -1.0, "-1"),
    ("mu", doubles(1.0, 1.0, 1.0, -2.5, 1.0, 1.0), "-2.5.*tet 3"),
    ("lam", -2e4, "-20000.*mu 10000"),
    ("lam", doubles(1.0, -1e4 - 1, 1.0, 1.0, 1.0, 1.0), "-10001.*tet 1"),
    ("density", -5.0, "-"),
    ("density", 0.0, "0"),
    ("density", doubles(1e3, 1e3, -100.0, 1e3, 1e3, 1e3), "-100"),
    ("floor_kappa", -1.0, "-1"),
    ("floor_dhat", 0.0, "0"),
    ("floor_dhat", -1.0, "-1"),
    ("floor_damping", -1.0, "-1"),
    ("anchor_stiffness", -1.0, "-1"),
    ("flor_kappa", 1.0, r": is 'floor_kappa' meant\?$"),
    ("friction", 1.0, "has no Friction among its"),
    ("pair_kappa", 1.0, "has no PairBarrier among its"),
    ("muu", 1.0, r": is 'mu' meant\?$"),
    ("qqq", 1.0, r"anchor_points\)$"),
    ("floor_kappa", torch.ones(1, 1, dtype=torch.float64), r"shape \[1, 1\]$"),
    # rest shapes that are no shapes
    ("rest_points", torch.from_numpy(MESH.points * [-1.0, 1.0, 1.0]), r"-0\.16.* at tet 0 of scene 0"),
    ("rest_points", torch.from_numpy(MESH.points * [1.0, 1.0, 0.0]), r"got 0 at tet 0 of scene 0"),
    ("rest_points", spoiled(-1.0, 7), r"-.* at tet 0 of scene 0"),
]

SOLVERS: list[tuple[str, Any, str]] = [
    *(("time_step", value, got) for value, got in
      ((0, "0"), (-0.1, "-0.1"), (NAN, "nan"), (INF, "inf"), (10**400, "1329 bits"), (True, "bool"), ("fast", "str"),
       (None, "None"))),
    *(("sweeps", value, got) for value, got in
      ((-1, "-1"), (1.5, "1.5"), (2.0, "2.0"), (10**400, "10000"), (True, "bool"), ("3", "'3'"), (None, "None"))),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value", "got"), SOLVERS, ids=lambda a: str(a)[:24])
def test_bad_argument_of_a_solver(name: str, value: Any, got: str) -> None:
    given: dict[str, Any] = {"time_step": 0.01, "sweeps": 1, name: value}
    raises(lambda: dv.VBD(**given), name, got)


@pytest.mark.parametrize("time_step", (1e-310, 1e-160, 1e160))
def test_a_time_step_whose_square_no_float_holds(device: str, time_step: float) -> None:
    raises(lambda: step_with(model_of(device), "solver", dv.VBD(time_step, 1)), "time_step", re.escape(str(time_step)))


def step_with(model: dv.Model, name: str, value: Any, lead: tuple[int, ...] = (), **options: Any) -> Any:
    device = model.device if isinstance(model, dv.Model) else "cpu"
    x = torch.from_numpy(MESH.points.copy()).repeat(*lead, 1, 1).to(device)
    given: dict[str, Any] = {"x": x, "v": torch.zeros_like(x), **STEP, **options}
    value = value if getattr(value, "is_meta", False) else on_device(value, device)
    return dv.step(model, **given | {name: value})


@pytest.mark.parametrize(("name", "value", "got"), ARGUMENTS, ids=lambda a: str(a)[:24].replace("\n", " "))
def test_bad_argument_of_a_step(device: str, value_checks: None, name: str, value: Any, got: str) -> None:
    model = model_of(device)
    before = value.clone() if isinstance(value, Tensor) and value.device.type == "cpu" else None
    raises(lambda: step_with(model, name, value), name, got)
    if before is not None:
        assert torch.equal(value.nan_to_num(), before.nan_to_num())
    step_with(model, "mu", 1e4)  # the Model still works


@pytest.mark.parametrize(
    ("name", "value"), [("floor_height", doubles(NAN)), ("floor_normal", doubles([0.0, NAN, 0.0])),
                        ("floor_normal", doubles([0.0, 0.0, 0.0])), ("anchor_points", spoiled(NAN, 3, 1))],
)  # fmt: skip
def test_parameters_of_energies_are_finite(device: str, value_checks: None, name: str, value: Tensor) -> None:
    raises(lambda: step_with(model_of(device), name, value), name, "length 0" if bool((value == 0).all()) else "nan")


def test_none_is_a_default(device: str) -> None:
    model = model_of(device)
    expected = step_with(model, "mu", 1e4)[0]
    for name in ("gravity", "floor_kappa", "prescribed", "rest_points"):
        assert torch.equal(step_with(model, name, None)[0], expected)


def test_negative_lam_is_legal_where_its_block_allows_it(device: str, value_checks: None) -> None:
    model, paper = model_of(device), dv.VBD(0.01, 1, block="paper")
    assert torch.isfinite(step_with(model, "lam", -9e3)[0]).all()
    raises(lambda: step_with(model, "lam", -1.0, solver=paper), "lam", "-1")
    for solver in (STEP["solver"], paper):
        assert torch.isfinite(step_with(model, "mu", 0.0, solver=solver)[0]).all()


@pytest.mark.parametrize(
    ("name", "shape"), [("mu", (3, 1)), ("lam", (3, 6)), ("density", (3, 1)), ("force", (3, 8, 3)),
                        ("gravity", (3, 1, 3)), ("rest_points", (3, 8, 3)), ("anchor_points", (3, 8, 3))],
)  # fmt: skip
def test_mismatched_batch(device: str, name: str, shape: tuple[int, ...]) -> None:
    raises(lambda: step_with(model_of(device), name, ones(*shape), lead=(2,)), name, re.escape(str(list(shape))))


@pytest.mark.parametrize("name", ["x", "v", "force", "prescribed", "rest_points", "mu", "lam", "density"])
def test_only_dense_tensors(device: str, name: str) -> None:
    full = ones(8, 3) if name in ("x", "v", "force", "prescribed", "rest_points") else ones(6)
    raises(lambda: step_with(model_of(device), name, full.to_sparse()), name, r"torch.sparse_coo: use \.to_dense")
    for layout in (torch.strided, torch.jagged):
        nested = torch.nested.as_nested_tensor([full, full], layout=layout)
        raises(lambda nested=nested: step_with(model_of(device), name, nested), name, "nested")


@pytest.mark.parametrize(
    ("name", "shape", "hint"), [("mu", (3,), [3, 1]), ("lam", (3,), [3, 1]), ("density", (3,), [3, 1]),
                                ("gravity", (3, 3), [3, 1, 3]), ("force", (3, 3), [3, 1, 3])],
)  # fmt: skip
def test_one_value_for_each_scene_gets_a_hint(device: str, name: str, shape: tuple[int, ...], hint: list[int]) -> None:
    lead = (3,)
    if name in ("gravity", "force"):  # 3 scenes of 3 numbers would broadcast where there are 3 vertices
        shape, hint, lead = (5, 3), [5, 1, 3], (5,)
    raises(lambda: step_with(model_of(device), name, ones(*shape), lead=lead), name, re.escape(f"has shape {hint}"))
    step_with(model_of(device), name, ones(*hint), lead=lead)
    raises(lambda: step_with(model_of(device), "mu", ones(2), lead=(3,)), "mu", r"got shape \[2\]$")


def test_numbers_of_numpy_are_numbers(device: str) -> None:
    expected = step_with(model_of(device), "mu", 1e4)[0]
    for number in (np.float64(1e4), np.float32(1e4), np.int64(10_000)):
        assert torch.equal(step_with(model_of(device), "mu", number)[0], expected)


@pytest.mark.parametrize("name", ["mu", "lam", "density", "force", "prescribed", "floor_kappa"])
@pytest.mark.parametrize("number", [1e39, 10**39])
def test_numbers_that_float32_cannot_hold(device: str, name: str, number: float) -> None:
    model = model_of(device, dtype=torch.float32)
    x = model.rest_points
    raises(lambda: dv.step(model, x, 0 * x, **STEP | {name: number}), name, r"torch.float32 can hold .* got 1e\+39")


def test_a_value_check_names_the_scene(device: str, value_checks: None) -> None:
    raises(lambda: step_with(model_of(device), "mu", doubles([1.0], [-1.0]), lead=(2,)), "mu", "-1 at tet 0 of scene 1")
    second = torch.stack([spoiled(0.0, 0, 0), spoiled(NAN, 3, 1)])
    raises(
        lambda: step_with(model_of(device), "x", second, v=torch.zeros_like(second, device=device)),
        "x",
        "vertex 3 of scene 1",
    )


def test_values_that_are_not_read_are_not_checked(device: str, value_checks: None) -> None:
    model = model_of(device)
    prescribed = torch.where(model.pinned[:, None], model.rest_points, NAN).requires_grad_()
    x, _ = step_with(model, "prescribed", prescribed)
    assert torch.isfinite(x).all()
    (slope,) = torch.autograd.grad(x.sum(), prescribed)
    assert torch.isfinite(slope).all()
    assert (slope[model.pinned] != 0).all() and (slope[~model.pinned] == 0).all()


def test_a_model_of_another_class_or_mesh() -> None:
    raises(lambda: step_with(MESH, "mu", 1.0), "model", "TetMesh")
    other = dv.Model(dv.mesh.cube(3, split="kuhn"))
    raises(lambda: step_with(other, "mu", 1.0), "x", r"\[8, 3\]")


# --- debug_checks -----------------------------------------------------------------------------------------------------

HUGE = {"mu": 1e305, "lam": 1e308}


@pytest.mark.parametrize("lead", [(), (1,), (2,), (5,)])
def test_debug_checks_say_where_a_position_ceased_to_be_finite(device: str, lead: tuple[int, ...]) -> None:
    model, solver = model_of(device), dv.VBD(1.0, 3, start="predictor")  # the other start is at rest and stays finite
    x = model.rest_points.repeat(*lead, 1, 1)
    force = torch.zeros_like(x)
    force.reshape(-1, 8, 3)[-1] = 1e150  # the last scene only
    options = HUGE | {"force": force}
    if lead:
        for name in ("mu", "lam"):
            options[name] = torch.full((*lead, 1), 1e4, dtype=torch.float64, device=device)
            options[name][-1] = HUGE[name]
    with debug_checks():
        with pytest.raises(RuntimeError) as error:
            dv.step(model, x, torch.zeros_like(x), solver, **options)
    scene = lead[-1] - 1 if lead else 0
    assert re.search(rf"step 0, sweep \d+, color \d+, vertex \d+, scene {scene}\b", str(error.value)), str(error.value)
    x, _ = dv.step(model, x, torch.zeros_like(x), solver, **options)  # off again
    assert not torch.isfinite(x).all()


def test_debug_checks_change_nothing_in_a_sound_step(device: str) -> None:
    model = model_of(device)
    x = model.rest_points + 0.01
    expected = dv.step(model, x, torch.zeros_like(x), **STEP)
    with debug_checks():
        actual = dv.step(model, x, torch.zeros_like(x), **STEP)
    assert torch.equal(actual[0], expected[0]) and torch.equal(actual[1], expected[1])


@pytest.mark.parametrize("name", ["bogus", 3, ["grid"], {}])
def test_an_unknown_regime(name: Any) -> None:
    with pytest.raises(ValueError, match="regime: expected one of"), regime(name):
        pass


# --- rare arguments ---------------------------------------------------------------------------------------------------


GIVEN: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "solver": dv.VBD(0.01, 2)}
CUBE = dv.mesh.cube(2, size=0.1)


@pytest.mark.parametrize("steps", (0, 2))
@pytest.mark.parametrize("gravity", ([-9.0], -9.0, [[-9.0]], [np.float32(-9)] * 3, np.full(3, -9)), ids=str)
def test_gravity_of_any_shape_that_broadcasts(gravity: Any, steps: int, device: str) -> None:
    model = dv.Model(CUBE, device=device)
    x = model.rest_points
    given = gravity if isinstance(gravity, np.ndarray) or np.shape(gravity) == (3,) else torch.tensor(gravity).to(x)
    wanted = dv.rollout(model, x, x * 0, steps=steps, gravity=(-9.0, -9.0, -9.0), **GIVEN).x
    assert torch.equal(dv.rollout(model, x, x * 0, steps=steps, gravity=given, **GIVEN).x, wanted)
    if steps:
        assert not torch.equal(wanted[-1], x)
        v = torch.zeros_like(x)
        assert torch.equal(dv.step(model, x, v, gravity=given, **GIVEN)[0], wanted[1])


@pytest.mark.parametrize("gravity", ([0.0, 1.0], torch.zeros(4), [True, False, True]), ids=("list", "tensor", "bools"))
def test_gravity_is_looked_at_without_steps_too(gravity: Any) -> None:
    model = dv.Model(CUBE)
    x = model.rest_points
    with pytest.raises((ValueError, TypeError), match="gravity: expected"):
        dv.rollout(model, x, x * 0, steps=0, gravity=gravity, **GIVEN)


@pytest.mark.parametrize("name", ("gravity", "mu"))
def test_a_function_that_returns_no_number_is_named_under_checkpoints(name: str) -> None:
    model = dv.Model(CUBE)
    x = model.rest_points.requires_grad_()
    bad = [0.0, float("nan"), 0.0] if name == "gravity" else float("nan")
    with pytest.raises(ValueError, match=f"{name}: expected .*nan.*in step 0"):
        dv.rollout(model, x, x.detach() * 0, steps=4, checkpoint_every=2, **GIVEN | {name: lambda step, x, v: bad})


def test_values_that_are_not_finite_under_vmap() -> None:
    model = dv.Model(CUBE)
    x = model.rest_points.expand(2, -1, -1)
    with pytest.raises(ValueError, match="gravity.*expected finite values, got nan"):
        torch.func.vmap(lambda q: dv.step(model, q, q * 0, gravity=(0.0, float("nan"), 0.0), **GIVEN)[0])(x)


@pytest.mark.parametrize("sweeps", (0, 1))
@pytest.mark.parametrize("more", ((), (dv.Friction(0.3),), (dv.PairBarrier(),)), ids=("alone", "friction", "pairs"))
def test_a_start_on_the_wrong_side_of_a_floor(more: tuple, sweeps: int) -> None:
    floor = dv.FloorBarrier(normal=[[0, 1, 0], [0, 1, 0]], height=[-1.0, 0.01])
    model = dv.Model(CUBE, energies=(dv.StableNeoHookean(), floor, *more), pinned=[0])
    x = model.rest_points.expand(2, -1, -1).clone()
    x[0, :, 1] += 0.1
    said = "x: expected every unpinned vertex above floor plane 1, got 3 on or below it in scene 1: vertices "
    with pytest.raises(ValueError, match=said):
        dv.step(model, x, x * 0, dv.VBD(0.01, sweeps), mu=1e4, lam=1e4)


@pytest.mark.parametrize("speed", (1e10, 1e100, 1e300))
@pytest.mark.parametrize("sweeps", (0, 1, 8))
def test_a_step_on_a_floor_with_friction_that_leaves_all_bounds_raises_or_is_finite(speed: float, sweeps: int) -> None:
    """Positions that are spread over kilometers are warned of."""
    floor = dv.FloorBarrier(normal=[0.6, 0.8, 0], height=-1e-9, kappa=1e3, dhat=0.01)
    model = dv.Model(CUBE, energies=(dv.StableNeoHookean(), floor, dv.Friction(0.3)))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[:, 1], v[0, 0] = -speed, -speed / 3
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            end, after = dv.step(model, x, v, dv.VBD(0.01, sweeps), mu=1e4, lam=1e4)
        except RuntimeError as error:
            assert "positions became non-finite in the step" in str(error)
            return
    assert torch.isfinite(end).all() and torch.isfinite(after).all()
    spread = bool((end - x).abs().max() > 1e3)
    assert spread == any("positions that are spread over" in str(w.message) for w in told)
