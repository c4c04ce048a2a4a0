"""Rollouts: the same numbers as a loop of steps, under every checkpoint schedule, tape and save mode."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv
from bench import bits
from diffvbd.step import contact
from diffvbd.testing import build_scene, relative_error, tolerance

STEPS = 7
SWEEPS = 3
SCHEDULES = [
    None,
    "auto",
    1,
    2,
    3,
    STEPS,
    100,
    dv.BinomialCheckpoints(1),
    dv.BinomialCheckpoints(2),
    dv.BinomialCheckpoints(3),
    dv.BinomialCheckpoints(50),
]
CASES = ["plain", "floor_damped", "anchored", "batch"]


def leaves_of(inputs: dict[str, Any]) -> tuple[dict[str, Any], list[Tensor]]:
    """The inputs with fresh leaves, and the leaves."""
    call = {name: t.clone().requires_grad_() for name, t in inputs.items()}
    return call, list(call.values())


def loss_of_frames(x: Tensor, v: Tensor) -> Tensor:
    weights = torch.linspace(1, 2, x.numel(), dtype=x.dtype, device=x.device).reshape(x.shape)
    return (weights * x.square()).sum() + 0.01 * (weights * v).sum()


def looped(scene: Any, model: dv.Model, call: dict[str, Any], steps: int = STEPS) -> tuple[Tensor, Tensor]:
    options = {k: value for k, value in call.items() if k not in ("x", "v")}
    x, v = call["x"], call["v"]
    frames = [(x, v)]
    for _ in range(steps):
        x, v = dv.step(model, x, v, scene.solver(SWEEPS), **options)
        frames.append((x, v))
    return torch.stack([f[0] for f in frames]), torch.stack([f[1] for f in frames])


@pytest.mark.parametrize("case", CASES)
def test_rollout_is_a_loop_of_steps_under_every_schedule(device: str, case: str) -> None:
    scene = build_scene(case)
    model, inputs = scene.model(device), scene.inputs(device=device)
    call, leaves = leaves_of(inputs)
    expected = looped(scene, model, call)
    slopes = torch.autograd.grad(loss_of_frames(*expected), leaves, allow_unused=True)
    assert sum(s is not None and float(s.abs().max()) > 0 for s in slopes) >= 7
    first = None
    for schedule in SCHEDULES:
        call, leaves = leaves_of(inputs)
        trajectory = dv.rollout(model, **call, steps=STEPS, checkpoint_every=schedule, solver=scene.solver(SWEEPS))
        assert trajectory.steps == list(range(STEPS + 1))
        assert torch.equal(trajectory.x, expected[0]) and torch.equal(trajectory.v, expected[1])
        grads = torch.autograd.grad(loss_of_frames(trajectory.x, trajectory.v), leaves, allow_unused=True)
        for a, b in zip(grads, slopes, strict=True):
            assert (a is None) == (b is None)
            # The loop prepares masses and rest shape anew in each step, so the sums over steps associate differently.
            assert a is None or relative_error(a, b) <= tolerance("schedules"), schedule
        # Among schedules nothing differs: the same steps, the same order of accumulation.
        first = first or grads
        assert all(a is None or torch.equal(a, b) for a, b in zip(grads, first, strict=True)), schedule


@pytest.mark.parametrize("tape", ["full", "compact", "recompute"])
def test_tapes_under_checkpoints(device: str, tape: str) -> None:
    scene = build_scene("floor_filtered")
    model, inputs = scene.model(device), scene.inputs(device=device)
    results = []
    for kept, schedule in (("full", None), (tape, 3)):
        call, leaves = leaves_of(inputs)
        trajectory = dv.rollout(
            model, **call, solver=scene.solver(SWEEPS, tape=kept), steps=5, checkpoint_every=schedule
        )
        results.append(torch.autograd.grad(loss_of_frames(trajectory.x, trajectory.v), leaves, allow_unused=True))
    assert all(a is None or relative_error(a, b) <= tolerance("schedules") for a, b in zip(*results, strict=True))


def test_no_grad_rollouts_save_nothing(device: str) -> None:
    scene = build_scene("plain")
    model, inputs = scene.model(device), scene.inputs(device=device)
    expected = looped(scene, model, inputs)
    for schedule in (None, 2, dv.BinomialCheckpoints(2)):
        trajectory = dv.rollout(model, solver=scene.solver(SWEEPS), **inputs, steps=STEPS, checkpoint_every=schedule)
        assert torch.equal(trajectory.x, expected[0]) and not trajectory.x.requires_grad


# --- callables and per_step -------------------------------------------------------------------------------------------


def controlled(device: str, schedule: Any, every_argument: bool) -> list[Tensor]:
    """Gradients of a network that a force (and a stiffness) close over."""
    scene = build_scene("floor_active")
    model, inputs = scene.model(device), scene.inputs(device=device)
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(7, 5), torch.nn.Tanh(), torch.nn.Linear(5, 3)).double().to(device)
    scale = torch.tensor(1.1, dtype=torch.float64, device=device, requires_grad=True)

    def force(k: int, x: Tensor, v: Tensor) -> Tensor:
        clock = torch.full_like(x[..., :1], float(k))
        return network(torch.cat([x, v, clock], -1))

    options = inputs | {"force": force}
    if every_argument:
        options["mu"] = lambda k, x, v: inputs["mu"] * scale * (1 + 0.1 * k)
        options["floor_kappa"] = lambda k, x, v: 2e4 * scale
    trajectory = dv.rollout(model, **options, steps=STEPS, checkpoint_every=schedule, solver=scene.solver(SWEEPS))
    leaves = [*network.parameters(), *([scale] if every_argument else [])]
    return list(torch.autograd.grad(loss_of_frames(trajectory.x, trajectory.v), leaves))


@pytest.mark.parametrize("every_argument", [False, True])
def test_callables_that_close_over_a_network_get_gradients_under_every_schedule(
    device: str, every_argument: bool
) -> None:
    expected = controlled(device, None, every_argument)
    assert all(g.abs().max() > 0 for g in expected)
    for schedule in (1, 3, dv.BinomialCheckpoints(1), dv.BinomialCheckpoints(3)):
        for a, b in zip(controlled(device, schedule, every_argument), expected, strict=True):
            assert relative_error(a, b) <= tolerance("schedules")


def values_per_step(name: str, value: Tensor) -> Tensor:
    factors = 1 + 0.05 * torch.arange(STEPS, dtype=value.dtype, device=value.device)
    return value * factors.reshape(-1, *[1] * value.dim())


@pytest.mark.parametrize(
    "name",
    ["mu", "lam", "force", "gravity", "prescribed", "rest_points", "density", "floor_kappa",
     "floor_height", "anchor_stiffness", "anchor_points"],
)  # fmt: skip
@pytest.mark.parametrize("schedule", [None, 3])
def test_per_step_and_callables_of_every_argument(device: str, name: str, schedule: Any) -> None:
    scene = build_scene("anchored")
    model, inputs = scene.model(device), scene.inputs(device=device)
    base = inputs[name]

    def given(value: Any) -> dict[str, Any]:
        return inputs | {name: value}

    results = []
    for form in ("loop", "per_step", "callable"):
        values = values_per_step(name, base).requires_grad_()
        if form == "loop":
            x, v = inputs["x"], inputs["v"]
            for k in range(STEPS):
                x, v = dv.step(model, **(given(values[k]) | {"x": x, "v": v}), solver=scene.solver(SWEEPS))
        else:
            value = dv.per_step(values) if form == "per_step" else lambda k, x, v, values=values: values[k]
            trajectory = dv.rollout(
                model, **given(value), steps=STEPS, checkpoint_every=schedule, save="last", solver=scene.solver(SWEEPS)
            )
            x, v = trajectory.x[-1], trajectory.v[-1]
        results.append((x, v, *torch.autograd.grad(loss_of_frames(x, v), values)))
    assert results[0][2].abs().max() > 0
    assert (results[0][2][0] - results[0][2][-1]).abs().max() > 0  # every step has its own gradient
    for result in results[1:]:
        assert torch.equal(result[0], results[0][0]) and torch.equal(result[1], results[0][1])
        assert relative_error(result[2], results[0][2]) <= tolerance("schedules")


@pytest.mark.parametrize("name", ["mu", "force", "prescribed", "density", "anchor_stiffness"])
def test_wrong_number_of_steps_raises(name: str) -> None:
    scene = build_scene("anchored")
    model, inputs = scene.model(), scene.inputs()
    base = inputs[name]
    value: Any = dv.per_step(torch.stack([base] * (STEPS + 1)))
    with pytest.raises(ValueError, match=f"{name}.*{STEPS} steps.*{STEPS + 1}"):
        dv.rollout(model, **(inputs | {name: value}), steps=STEPS, solver=scene.solver(SWEEPS))


@pytest.mark.parametrize("value", [3.0, [1.0, 2.0], torch.tensor(1.0), None])
def test_per_step_wants_a_tensor_with_a_leading_dimension(value: Any) -> None:
    with pytest.raises(TypeError, match=r"\[steps, \.\.\.\]"):
        dv.per_step(value)


# --- what a trajectory holds ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schedule", [None, 2, dv.BinomialCheckpoints(2)])
@pytest.mark.parametrize(
    ("save", "kept"),
    [("all", [0, 1, 2, 3, 4, 5, 6, 7]), ("last", [7]), (1, [0, 1, 2, 3, 4, 5, 6, 7]), (3, [0, 3, 6, 7]), (7, [0, 7]),
     (9, [0, 7])],
)  # fmt: skip
def test_save_modes(device: str, save: Any, kept: list[int], schedule: Any) -> None:
    scene = build_scene("batch")
    model, inputs = scene.model(device), scene.inputs(device=device)
    frames = looped(scene, model, inputs)
    call, leaves = leaves_of(inputs)
    trajectory = dv.rollout(
        model, **call, steps=STEPS, save=save, checkpoint_every=schedule, solver=scene.solver(SWEEPS)
    )
    assert trajectory.steps == kept
    assert torch.equal(trajectory.x, frames[0][kept]) and torch.equal(trajectory.v, frames[1][kept])
    torch.autograd.grad(loss_of_frames(trajectory.x, trajectory.v), leaves, allow_unused=True)


@pytest.mark.parametrize("schedule", [None, 3, dv.BinomialCheckpoints(2)])
def test_observations_are_stacked_and_differentiable(device: str, schedule: Any) -> None:
    scene = build_scene("plain")
    model, inputs = scene.model(device), scene.inputs(device=device)
    frames = looped(scene, model, inputs)
    tip = frames[0][1:, -1]
    observers = {
        "tensor": lambda k, x, v: x[-1],
        "tuple": lambda k, x, v: (x[-1], v.square().sum(), torch.tensor(k)),
        "dict": lambda k, x, v: {"tip": x[-1], "nested": [v.square().sum()]},
        "none": lambda k, x, v: None,
    }
    seen = {}
    for form, observe in observers.items():
        call, leaves = leaves_of(inputs)
        options = {"steps": STEPS, "save": "last", "checkpoint_every": schedule}
        seen[form] = dv.rollout(model, **call, observe=observe, **options, solver=scene.solver(SWEEPS)).observations
        if form == "tensor":
            (slope,) = torch.autograd.grad(seen[form].square().sum(), leaves[0])
    assert torch.equal(seen["tensor"], tip)
    assert isinstance(seen["tuple"], tuple) and torch.equal(seen["tuple"][0], tip)
    assert relative_error(seen["tuple"][1], frames[1][1:].square().sum((-1, -2))) <= tolerance("formula")
    assert seen["tuple"][2].tolist() == list(range(1, STEPS + 1))
    assert torch.equal(seen["dict"]["tip"], tip) and torch.equal(seen["dict"]["nested"][0], seen["tuple"][1])
    assert seen["none"] is None
    call, leaves = leaves_of(inputs)
    (expected,) = torch.autograd.grad(looped(scene, model, call)[0][1:, -1].square().sum(), leaves[0])
    assert expected.abs().max() > 0
    assert relative_error(slope, expected) <= tolerance("schedules")


def test_observing_something_else_raises() -> None:
    scene = build_scene("plain")
    with pytest.raises(TypeError, match=r"values: expected a tensor of shape \[steps, ...\], got shape \[\]"):
        dv.per_step(torch.ones(()))
    with pytest.raises(TypeError, match="observe.*float"):
        dv.rollout(scene.model(), **scene.inputs(), steps=2, observe=lambda k, x, v: float(k), solver=scene.solver(1))


def test_zero_steps_return_the_initial_state(device: str) -> None:
    scene = build_scene("batch")
    model, inputs = scene.model(device), scene.inputs(device=device)
    for save in ("all", "last", 2):
        for schedule in (None, "auto", 2, dv.BinomialCheckpoints(1)):
            call, leaves = leaves_of(inputs)
            options = {"steps": 0, "save": save, "checkpoint_every": schedule}
            trajectory = dv.rollout(model, **call, observe=lambda k, x, v: x, **options, solver=scene.solver(SWEEPS))
            assert trajectory.steps == [0] and trajectory.observations is None
            assert torch.equal(trajectory.x[0], inputs["x"]) and torch.equal(trajectory.v[0], inputs["v"])
            (slope,) = torch.autograd.grad(trajectory.x.sum(), leaves[0])
            assert torch.equal(slope, torch.ones_like(slope))


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [("steps", -1, ValueError), ("steps", 2.5, TypeError), ("steps", True, TypeError), ("save", "every", ValueError),
     ("save", 0, ValueError), ("save", True, ValueError), ("checkpoint_every", 0, ValueError),
     ("checkpoint_every", "even", ValueError), ("checkpoint_every", 1.5, TypeError),
     ("checkpoint_every", True, TypeError)],
)  # fmt: skip
def test_bad_options_raise(name: str, value: Any, error: type[Exception]) -> None:
    scene = build_scene("plain")
    options = scene.inputs() | {"steps": 2, name: value}
    with pytest.raises(error, match=f"{name}: expected .*got"):
        dv.rollout(scene.model(), solver=scene.solver(1), **options)


# --- cost of a schedule -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "snapshots"), [(10, 1), (12, 2), (20, 3)])
def test_binomial_runs_steps_as_rarely_as_promised(steps: int, snapshots: int) -> None:
    """No step runs forward more than 1 + t times, t the least number with C(snapshots + t, t) >= steps."""
    from math import comb

    scene = build_scene("plain")
    model, inputs = scene.model(), scene.inputs()
    runs = [0] * steps

    def force(k: int, x: Tensor, v: Tensor) -> Tensor:
        runs[k] += 1
        return inputs["force"]

    x = inputs["x"].clone().requires_grad_()
    options = inputs | {"x": x, "force": force}
    schedule = dv.BinomialCheckpoints(snapshots)
    trajectory = dv.rollout(
        model, **options, steps=steps, save="last", checkpoint_every=schedule, solver=scene.solver(1)
    )
    assert runs == [1] * steps
    trajectory.x.sum().backward()
    repeats = next(t for t in range(steps + 1) if comb(snapshots + t, t) >= steps)
    assert max(runs) <= 1 + repeats
    assert sum(runs) > steps


@pytest.mark.parametrize("schedule", [2, dv.BinomialCheckpoints(2)])
@pytest.mark.parametrize("name", ["mu", "lam", "force", "gravity", "prescribed", "floor_kappa"])
def test_changing_an_argument_before_a_checkpointed_backward_raises(device: str, name: str, schedule: Any) -> None:
    scene = build_scene("floor_damped")
    model, inputs = scene.model(device), scene.inputs(device=device)
    call, _ = leaves_of(inputs)
    options = {k: value for k, value in call.items() if k not in ("x", "v")}
    end = dv.rollout(
        model, call["x"], call["v"], steps=4, checkpoint_every=schedule, **options, solver=scene.solver(1)
    ).x[-1]
    changed = call[name]
    with torch.no_grad():
        changed.mul_(2)
    with pytest.raises(RuntimeError, match="changed in place|modified by an inplace operation"):
        end.sum().backward()


# --- values of steps --------------------------------------------------------------------------------------------------


FEW, TWO_SWEEPS = 6, 3


@pytest.mark.parametrize("name", ["mu", "force", "prescribed"])
def test_values_of_all_steps_without_per_step_say_what_takes_them(name: str) -> None:
    scene = build_scene("anchored")
    model, inputs = scene.model(), scene.inputs()
    whole = inputs[name].expand(*inputs["x"].shape[:-2], *inputs[name].shape[-1 if name == "mu" else -2 :])
    with pytest.raises(ValueError, match=rf"{name}: .*in a rollout, per_step\({name}\) takes one for each step"):
        dv.rollout(model, **(inputs | {name: torch.stack([whole] * FEW)}), steps=FEW, solver=scene.solver(TWO_SWEEPS))


@pytest.mark.parametrize("name", ["mu", "gravity", "prescribed", "rest_points"])
def test_a_function_that_returns_nothing_raises(name: str) -> None:
    """A forgotten return would otherwise be a grip that stays. Of forces, None says that a step has none."""
    scene = build_scene("anchored")
    model, inputs = scene.model(), scene.inputs()
    with pytest.raises(TypeError, match=f"{name}: expected a function that returns the value.*got None .in step 0"):
        dv.rollout(model, **(inputs | {name: lambda k, x, v: None}), steps=FEW, solver=scene.solver(TWO_SWEEPS))


def test_a_trajectory_prints_in_one_line() -> None:
    scene = build_scene("anchored")
    found = dv.rollout(scene.model(), **scene.inputs(), steps=4, save=2, solver=scene.solver(1))
    expected = f"Trajectory(3 frames of steps 0 to 4, x and v of shape {list(found.x.shape)})"
    assert repr(found) == expected


def test_a_force_of_none_is_no_force() -> None:
    scene = build_scene("anchored")
    model, inputs = scene.model(), {k: value for k, value in scene.inputs().items() if k != "force"}
    without = dv.rollout(model, **inputs, steps=FEW, solver=scene.solver(TWO_SWEEPS))
    none = dv.rollout(model, **inputs, force=lambda k, x, v: None, steps=FEW, solver=scene.solver(TWO_SWEEPS))
    assert torch.equal(none.x, without.x)


def test_an_error_of_a_step_says_which_step_it_was() -> None:
    """A muscle that turns a body inside out does so at some moment."""
    scene = build_scene("anchored")
    model, inputs = scene.model(), scene.inputs()
    rest = inputs["rest_points"] if inputs.get("rest_points") is not None else model.rest_points
    turned = inputs | {"rest_points": lambda k, x, v: rest if k < 2 else -rest}
    with pytest.raises(ValueError, match=r"rest_points: .*at tet \d+ of scene 0 .in step 2.$"):
        dv.rollout(model, **turned, steps=FEW, solver=scene.solver(TWO_SWEEPS))


@pytest.mark.parametrize(
    ("name", "function"), [("mu", lambda k: 1e4), ("force", lambda x, v: 0.0), ("anchor_stiffness", lambda: 1e3)]
)
def test_a_function_of_other_arguments_raises(name: str, function: Callable[..., Any]) -> None:
    scene = build_scene("anchored")
    value = function
    with pytest.raises(TypeError, match=rf"{name}.*: expected a function of step, x, v: too many positional"):
        dv.rollout(scene.model(), **(scene.inputs() | {name: value}), steps=FEW, solver=scene.solver(TWO_SWEEPS))


@pytest.mark.parametrize(
    ("observe", "says"),
    [
        (lambda x, v: x, "expected a function of step, x, v: too many positional"),
        (lambda x, v, step: x, "expected a function of step, x, v in this order, got x, v, step"),
        (lambda x, *rest, step=None: x, "expected a function of step, x, v in this order, got x"),
        (3, "expected a function of step, x, v, got int"),
        (lambda k, x, v: {str(k): x}, r"with the keys \['1'\] after each .* keys \['2'\] after step 2"),
        (lambda k, x, v: (x,) * (5 - k), "expected a tuple of 4 after each .* got a tuple of 3 after step 2"),
        (lambda k, x, v: (x,) * k, "expected a tuple of 1 after each .* got a tuple of 2 after step 2"),
        (lambda k, x, v: {"a": x} if k == 1 else x, r"with the keys \['a'\] after each .* got a tensor of shape"),
        (lambda k, x, v: None if k == 1 else x, "expected None after each .* got a tensor of shape"),
        (lambda k, x, v: {"a": x[:k]}, r"a tensor of shape \[1, .* after each .* \[2, .* after step 2"),
    ],
)
def test_what_observe_returns_is_alike_after_each_step(observe: Any, says: str) -> None:
    scene = build_scene("anchored")
    with pytest.raises((TypeError, ValueError), match=f"observe: .*{says}"):
        dv.rollout(scene.model(), **scene.inputs(), steps=3, observe=observe, solver=scene.solver(1))


def test_save_takes_words_and_integers() -> None:
    scene = build_scene("anchored")
    given = {**scene.inputs(), "steps": 5}
    assert dv.rollout(scene.model(), **given, save=np.int64(2), solver=scene.solver(1)).steps == [0, 2, 4, 5]
    for bad in (np.arange(2), torch.arange(2), 2.0, True, 0, "some"):
        with pytest.raises(ValueError, match='save: expected "all", "last" or an integer > 0, got'):
            dv.rollout(scene.model(), **given, save=bad, solver=scene.solver(1))
    with pytest.raises(TypeError, match="checkpoint_every: expected an integer, got ndarray"):
        dv.rollout(scene.model(), **given, checkpoint_every=np.arange(2), solver=scene.solver(1))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", ["force", "prescribed"])
def test_a_function_that_returns_no_finite_number_is_named(name: str) -> None:
    model = dv.Model(dv.mesh.cube(), pinned=[0])
    x, given = model.rest_points, {"mu": 1e4, "lam": 1e4, name: lambda k, x, v: float("inf")}
    with pytest.raises(ValueError, match=f"^{name}: expected finite values, got inf"):
        dv.rollout(model, x, 0 * x, dv.VBD(0.01, TWO_SWEEPS), **given, steps=FEW)
    with pytest.raises(ValueError, match=f"^{name}: expected finite values, got inf"):
        dv.solve(model, x, 0 * x, dv.VBD(0.01, 1), **(given | {name: float("inf")}))


# --- functions that return something else under checkpoints -----------------------------------------------------------


MESH = dv.mesh.beam(3, 2, 2, size=(0.3, 0.1, 0.1))
REPEATED = (None, 3, dv.BinomialCheckpoints(2))


def end(model: dv.Model, force: Callable[[int, Tensor, Tensor], Any], schedule: Any) -> Tensor:
    x = model.rest_points
    motion = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(0.01, 3), steps=7, mu=1e5, lam=1e5, force=force,
                        checkpoint_every=schedule, save="last")  # fmt: skip
    return motion.x[-1, :, 1].sum()


def beam(device: str) -> dv.Model:
    return dv.Model(MESH, pinned=MESH.points[:, 0] == 0, device=device)


def assert_refused(loss: Tensor, weight: Tensor) -> None:
    if weight.is_cuda:
        assert torch.autograd.grad(loss, weight)[0].isnan().all()
    else:
        with pytest.raises(RuntimeError, match="force: expected the same value for step"):
            torch.autograd.grad(loss, weight)


def test_weights_that_change_in_place(device: str) -> None:
    model = beam(device)
    p = model.rest_points.new_tensor(0.3).requires_grad_()
    loss = end(model, lambda k, x, v: -10.0 * p * v, 3)
    with torch.no_grad():
        p.mul_(2)
    assert_refused(loss, p)


@pytest.mark.parametrize("schedule", REPEATED[1:], ids=str)
@pytest.mark.parametrize("kind", ["integral", "noise"])
def test_state_of_its_own(kind: str, schedule: Any, device: str) -> None:
    model, rng = beam(device), np.random.default_rng(0)
    p, rest = model.rest_points.new_tensor(5.0).requires_grad_(), model.rest_points
    kept = torch.zeros_like(rest)

    def force(k: int, x: Tensor, v: Tensor) -> Tensor:
        nonlocal kept
        kept = kept + 0.01 * (rest - x.detach()) if kind == "integral" else rest.new_tensor(rng.normal(size=x.shape))
        return p * kept

    assert torch.autograd.grad(end(model, force, None), p)[0].abs() > 0  # called once
    assert_refused(end(model, force, schedule), p)


@pytest.mark.parametrize("schedule", REPEATED, ids=str)
def test_what_repeats_itself_passes(schedule: Any, device: str) -> None:
    """Dropout, whose random numbers torch keeps; None; infinite values are named as ever."""
    model = beam(device)
    p = model.rest_points.new_tensor(5.0).requires_grad_()

    def gradient(schedule: Any) -> Tensor:
        torch.manual_seed(0)
        force = lambda k, x, v: None if k == 2 else torch.nn.functional.dropout(p * v + 1.0, 0.5)  # noqa: E731
        return torch.autograd.grad(end(model, force, schedule), p)[0]

    assert gradient(None).abs() > 0 and torch.equal(gradient(schedule), gradient(None))
    if device == "cpu":
        with pytest.raises(ValueError, match="force: expected finite values"):
            end(model, lambda k, x, v: p * torch.full_like(x, torch.inf), schedule)


def test_a_list_of_pairs_that_grows_begins_a_checkpointed_segment_again(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first attempt of a step that finds more pairs than fit saves tensors that a backward would not save again."""
    runs = bits.rollouts(device)["checkpoints, pairs"]
    expected, attempt, count = runs(), contact.ContactStep.run, [0]

    def too_few_once(self: Any, *given: Any) -> Tensor:
        count[0] += 1
        end = attempt(self, *given)
        if count[0] == 2:  # in a segment of two steps
            raise contact.TooManyPairs(10, "capacity")
        return end

    monkeypatch.setattr(contact.ContactStep, "run", too_few_once)
    found = runs()
    assert count[0] > 8 and found["grad_pair_kappa"].abs() > 0
    for name, value in expected.items():
        assert torch.equal(found[name].nan_to_num(), value.nan_to_num()), name
