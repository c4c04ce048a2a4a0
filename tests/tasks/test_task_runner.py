"""Claim: the runner's stages, optimisers and interruptions leave the numbers that one run in one go would have."""

import errno
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.task_checks import timeless
from torch import Tensor

import diffvbd as dv
from diffvbd import results
from diffvbd.tasks import Problem, Settings, Stage, solve, table
from diffvbd.tasks.optimizer import PATIENCE, Newton, optimizer_of
from diffvbd.tasks.runner import captured
from diffvbd.testing import tolerance

CENTER = (0.5, -1.0)


def toy(**changes: Any) -> Problem:
    """A bowl with a valley in three stages, and a state that its second stage changes."""
    a, b = (torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (2.0, 1.5))
    scale = torch.ones((), dtype=torch.float64)

    def loss() -> torch.Tensor:
        noise = 1e-3 * torch.rand((), dtype=torch.float64)  # an interruption must not change what is drawn
        return noise + scale * ((a - CENTER[0]).square() + (b - CENTER[1] * a).square() + 0.1 * (a - CENTER[0]) ** 4)

    def grow(iteration: int) -> None:
        scale.mul_(1.25)

    stages = [
        Stage(loss=loss, iterations=7, clip=0.5, name="adam"),
        Stage(loss=loss, iterations=9, before=grow, criterion="a", name="lbfgs",
              optimizer=lambda p: torch.optim.LBFGS(p, max_iter=3, line_search_fn="strong_wolfe")),
        Stage(loss=loss, iterations=7, moves=("b",), optimizer=lambda p: Newton(p, 1e-4, 0.3), name="newton"),
    ]  # fmt: skip
    problem = Problem("toy", {"a": a, "b": b}, stages, lambda: {"a": a.item()}, state={"scale": scale})
    return replace(problem, **changes)


def interrupt(problem: Problem, at: int) -> None:
    """Stops the problem before its evaluation number `at`, counted from 0 over all stages."""
    calls = iter(range(1000))

    def failing(loss: Callable[[], torch.Tensor]) -> Callable[[], torch.Tensor]:
        def evaluate() -> torch.Tensor:
            if next(calls) == at:
                raise KeyboardInterrupt
            return loss()

        return evaluate

    for stage in problem.stages:
        stage.loss = failing(stage.loss)


@pytest.mark.parametrize("at", (1, 6, 7, 11, 15, 16, 20, 22))
def test_a_run_interrupted_anywhere_ends_as_one_in_one_go(
    at: int, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    whole, parts = toy(), toy()
    expected = solve(whole, Settings(tmp_path / "whole"))
    assert len(expected.history) == 23
    interrupt(parts, at)
    with pytest.raises(KeyboardInterrupt):
        solve(parts, Settings(tmp_path / "parts"))
    resumed, evaluations = toy(), []
    first = resumed.stages[0].loss
    resumed.stages = [replace(stage, loss=lambda: (evaluations.append(1), first())[1]) for stage in resumed.stages]
    found = solve(resumed, Settings(tmp_path / "parts"))
    # the first loss once more, and of the steps done none
    done = int(re.findall(r"continuing after (\d+) iterations", capsys.readouterr().err)[0])
    assert len(evaluations) == 1 + 23 - done and at - 3 <= done <= at
    assert timeless(found.history) == timeless(expected.history)
    assert found.estimates == expected.estimates and found.best["iteration"] == expected.best["iteration"]
    for key, value in whole.parameters.items():
        assert torch.equal(resumed.parameters[key], value)


def test_each_stage_begins_with_the_best_of_the_one_before(tmp_path: Path) -> None:
    history = solve(toy(), Settings(tmp_path)).history
    stages = [[row for row in history if row["stage"] == k] for k in range(3)]
    assert [len(rows) for rows in stages] == [7, 9, 7]
    assert stages[1][0]["a"] == min(stages[0], key=lambda row: row["loss"])["a"]
    # judged by another key than the loss
    best = min(stages[1], key=lambda row: row["a"])
    assert stages[2][0]["a"] == best["a"] and best["loss"] > min(row["loss"] for row in stages[1])
    assert all(row["a"] == best["a"] for row in stages[2]), "the last stage moves b alone"
    assert stages[2][-1]["gradient_norm"] < tolerance("end_of_a_stage") * stages[2][0]["gradient_norm"]


@pytest.mark.parametrize("broken", [b"", b"no state", b"PK\x03\x04"])
def test_a_state_that_cannot_be_read_is_not_continued(
    broken: bytes, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    expected = solve(toy(), Settings(tmp_path / "whole")).history
    (tmp_path / "state.pt").write_bytes(broken)
    assert timeless(solve(toy(), Settings(tmp_path)).history) == timeless(expected)
    assert "starting anew" in capsys.readouterr().err


def test_a_state_whose_first_loss_is_another_is_not_continued(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    first = toy()
    interrupt(first, 5)
    with pytest.raises(KeyboardInterrupt):
        solve(first, Settings(tmp_path))
    other = toy()
    with torch.no_grad():
        other.parameters["a"].add_(1e-9)  # as if the code had changed, and no number of the protocol
    history = solve(other, Settings(tmp_path)).history
    assert "starting anew" in capsys.readouterr().err
    fresh = toy()
    with torch.no_grad():
        fresh.parameters["a"].add_(1e-9)
    assert timeless(history) == timeless(solve(fresh, Settings(tmp_path / "fresh")).history)


def test_a_loss_below_zero_is_not_an_end(tmp_path: Path) -> None:
    problem = toy()
    stage = problem.stages[0]
    loss = stage.loss
    problem.stages = [replace(stage, loss=lambda: loss() - 10)]
    result = solve(problem, Settings(tmp_path))
    assert len(result.history) == 7 and not result.converged
    problem = toy()
    problem.stages = [replace(problem.stages[0], gradient_tolerance=0.9)]
    result = solve(problem, Settings(tmp_path / "tolerance"))
    assert 1 < len(result.history) < 7 and result.converged


def flat() -> torch.Tensor:
    return torch.zeros(())


def two() -> torch.Tensor:
    return torch.zeros(2, requires_grad=True)


BAD = [
    ({"stages": []}, ValueError, "toy: stages: expected at least one Stage"),
    ({"stages": Stage(flat, 1)}, ValueError, "toy: stages: expected at least one Stage in a list"),
    ({"stages": [3]}, TypeError, r"stages\[0\]: expected a Stage, got int"),
    ({"stages": [Stage(lambda: 1.0, 1)]}, TypeError, r"stages\[0\].loss: expected a tensor, got float"),  # type: ignore
    ({"estimates": lambda: None}, TypeError, "estimates: expected a dict of numbers, got NoneType"),
    ({"stages": [Stage(flat, 0)]}, ValueError, r"stages\[0\].iterations: expected an integer of at least 1, got 0"),
    ({"stages": [Stage(flat, 2.5)]}, ValueError, r"stages\[0\].iterations: .* got 2.5"),  # type: ignore[arg-type]
    ({"stages": [Stage(flat, 1, clip=0.0)]}, ValueError, r"stages\[0\].clip: expected a number above 0, got 0.0"),
    ({"stages": [Stage(flat, 1, moves=("c",))]}, ValueError, r"stages\[0\].moves: expected a list of names"),
    ({"stages": [Stage(flat, 1, moves="a")]}, ValueError, r"stages\[0\].moves: expected a list .* got 'a'"),
    ({"stages": [Stage(flat, 1, moves=())]}, ValueError, r"stages\[0\].moves: expected a list of names"),
    ({"stages": [Stage(flat, 1)]}, ValueError, r"stages\[0\].loss: expected .* depends on the parameters"),
    ({"stages": [Stage(two, 1)]}, ValueError, r"stages\[0\].loss: expected a scalar, got shape \[2\]"),
    ({"parameters": {}}, TypeError, "toy: parameters: expected tensors by name"),
    (
        {"parameters": {"a": torch.zeros(())}},
        TypeError,
        r"\['a'\]: expected .* got a leaf with requires_grad = False",
    ),
    ({"truth": {"b": 1.0}}, ValueError, r"truth: expected names of estimates, got \['b'\]"),
    ({"truth": {"a": 0.0}}, ValueError, r"truth\['a'\]: expected a number .* got 0.0"),
    ({"truth": {"a": math.nan}}, ValueError, r"truth\['a'\]: expected a number .* got nan"),
    ({"truth": None}, TypeError, "truth: expected numbers by name, got None"),
    ({"stages": [Stage(flat, 1, learning_rate=-1.0)]}, ValueError, r"stages\[0\].learning_rate: .* above 0, got -1.0"),
    ({"stages": [Stage(flat, 1, tolerance=math.nan)]}, ValueError, r"stages\[0\].tolerance: .* at least 0, got nan"),
    ({"stages": [Stage(None, 1)]}, TypeError, r"stages\[0\].loss: expected a function, got None"),  # type: ignore
    ({"estimates": lambda: {"loss": 1.0}}, ValueError, r"estimates: expected other names .* got \['loss'\]"),
    ({"estimates": lambda: {"a": torch.ones(())}}, TypeError, "estimates: expected numbers, got Tensor for 'a'"),
]


@pytest.mark.parametrize(("changes", "error", "expected"), BAD)
def test_what_is_not_a_problem_is_refused(changes: dict, error: type, expected: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=expected):
        solve(toy(**changes), Settings(tmp_path))


def test_parameters_and_criteria_that_the_loss_does_not_know_are_refused(tmp_path: Path) -> None:
    problem = toy()
    a, stage = problem.parameters["a"], problem.stages[0]
    problem.stages = [replace(stage, loss=lambda: a.square())]
    with pytest.raises(ValueError, match=r"stages\[0\].loss: expected one that depends on \['b'\]; see Stage.moves"):
        solve(problem, Settings(tmp_path))
    problem.stages = [replace(stage, criterion="c")]
    with pytest.raises(ValueError, match=r"stages\[0\].criterion: expected a key of the history, got 'c'"):
        solve(problem, Settings(tmp_path))
    with pytest.raises(TypeError, match="out: expected a pathlib.Path, got 'runs'"):
        Settings("runs")  # type: ignore[arg-type]
    for seed in (-1, 2**64, 1.5):
        with pytest.raises(ValueError, match="seed: expected an integer"):
            Settings(tmp_path, seed=seed)  # type: ignore[arg-type]


def test_a_picture_that_fails_costs_no_result(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError("no paint")

    solve(toy(), Settings(tmp_path))
    (tmp_path / "animation.gif").write_bytes(b"of a run before")
    result = solve(toy(picture=fail, animation=fail), Settings(tmp_path))
    assert [path.name for path in result.files] == ["log.json"]
    assert "no picture.png: no paint" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.json"]


def test_a_full_disk_ends_a_run_by_name_and_leaves_no_half_of_a_file(tmp_path: Path) -> None:
    def fill(path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left on device: .*motion.npz"):
        solve(toy(animation=fill), Settings(tmp_path))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.json", "state.pt"]
    result = solve(toy(animation=lambda path: path.write_bytes(b"whole")), Settings(tmp_path))
    assert [path.name for path in result.files] == ["log.json", "motion.npz", "animation.gif"]


def test_another_run_puts_a_state_aside(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    first = toy()
    interrupt(first, 5)
    with pytest.raises(KeyboardInterrupt):
        solve(first, Settings(tmp_path))
    kept = (tmp_path / "state.pt").read_bytes()
    solve(toy(), Settings(tmp_path, seed=1))
    assert (tmp_path / "state.other.pt").read_bytes() == kept
    assert "starting anew" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["picture.png", "log.json"])
def test_files_that_are_not_of_the_task_stay(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"{}")
    (tmp_path / "video.mp4.part").write_bytes(b"half")
    with pytest.raises(ValueError, match=f"out: expected a folder without results, .* {name} of something else"):
        solve(toy(), Settings(tmp_path))
    (tmp_path / name).unlink()
    solve(toy(), Settings(tmp_path))
    with pytest.raises(ValueError, match="with those of bowl, got .* with log.json of toy"):
        solve(toy(name="bowl"), Settings(tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == {"log.json", "video.mp4.part"}
    with pytest.raises(ValueError, match="out: expected a folder or a place for one, got .*log.json"):
        solve(toy(), Settings(tmp_path / "log.json"))


@pytest.mark.parametrize("device", ["cud", "meta", "cuda:77"])
def test_a_device_that_is_not_there_is_refused(device: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="device: expected"):
        solve(toy(), Settings(tmp_path, device))


def newton_path(f: Callable[[torch.Tensor], torch.Tensor], start: float, steps: int, limit: float = 0.5) -> list[float]:
    p = torch.tensor(start, dtype=torch.float64, requires_grad=True)
    optimizer = Newton([p], probe=1e-5, limit=limit)

    def closure() -> float:
        p.grad = None
        loss = f(p)
        loss.backward()
        return loss.item()

    path = [p.item()]
    for _ in range(steps):
        optimizer.step(closure)
        path.append(p.item())
    return path


def test_newton_solves_a_parabola_in_one_step_and_goes_downhill_everywhere() -> None:
    assert newton_path(lambda p: 3 * (p - 0.2).square(), 0.5, 1)[-1] == pytest.approx(0.2, abs=tolerance("newton"))
    # where cos bends down, the signed step would climb to 0
    path = newton_path(torch.cos, 0.3, 12)
    assert path[1] == pytest.approx(0.3 + torch.tensor(0.3).tan().item(), rel=tolerance("damped_newton"))
    assert path[-1] == pytest.approx(torch.pi)
    assert newton_path(lambda p: 2 * p, 0.0, 3, limit=0.25)[-1] == -0.75  # no bend
    assert newton_path(lambda p: 0 * p, 0.4, 2)[-1] == 0.4
    with pytest.raises(ValueError, match=r"parameters: expected one of one element, got \[\[2\]\]"):
        Newton([torch.zeros(2, requires_grad=True)], 1e-3, 1.0)


def wall(optimizer: Callable[..., torch.optim.Optimizer]) -> Problem:
    """A slope behind a steep wall, where a line search needs more than the five evaluations of torch's default."""
    x = torch.zeros(2, dtype=torch.float64, requires_grad=True)

    def loss() -> torch.Tensor:
        return (-300 * x[0] - 1).exp() + x[0] + (x[1] - 1).square()

    stage = Stage(loss, 60, gradient_tolerance=tolerance("end_of_a_stage"), optimizer=optimizer)
    return Problem("wall", {"x": x}, [stage], lambda: {"first": x[0].item()})


@pytest.mark.parametrize("terminal", [False, True])
def test_an_optimizer_that_moves_nothing_ends_its_stage(
    terminal: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal)
    problem = wall(lambda p: torch.optim.SGD(p, lr=0.0))
    result = solve(problem, Settings(tmp_path))
    assert result.stalled and not result.converged and len(result.history) == 2
    assert "\nwall: stalled: the last two steps of the optimiser moved no parameter\n" in capsys.readouterr().err
    assert "stalled after 2 evaluations" in table(problem, result)
    assert "(lowest at evaluation 1)" in table(problem, result), "as the progress counts"
    assert json.loads((tmp_path / "log.json").read_text())["stalled"] is True


@pytest.mark.parametrize("at", [1, 2])
def test_an_interrupted_run_stalls_where_one_in_one_go_does(at: int, tmp_path: Path) -> None:
    def build() -> Problem:
        problem = wall(lambda p: torch.optim.SGD(p, lr=0.0))
        return replace(problem, stages=[replace(problem.stages[0], name=name) for name in ("first", "second")])

    expected = solve(build(), Settings(tmp_path / "whole"))
    first = build()
    interrupt(first, at)
    with pytest.raises(KeyboardInterrupt):
        solve(first, Settings(tmp_path / "parts"))
    found = solve(build(), Settings(tmp_path / "parts"))
    assert timeless(found.history) == timeless(expected.history) and len(found.history) == 4 and found.stalled


# --- losses with cliffs -----------------------------------------------------------------------------------------------


EDGE, HEIGHT, LOWEST = 1.0, 8.0, 0.999  # where the cliff is, how high, where the valley before it is lowest
STEPS, RATE = 60, 0.2


def cliff(x: torch.Tensor) -> torch.Tensor:
    """A valley that ends at a cliff, beyond which the slope leads away from it."""
    return torch.where(x < EDGE, (x - LOWEST).square() + 0.1, HEIGHT - 0.1 * x).sum()


def course(rough: bool) -> list[float]:
    """Losses on the way."""
    x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    optimizer, schedule = optimizer_of(Stage(lambda: cliff(x), STEPS, RATE, rough=rough), [x])
    assert schedule is not None
    losses: list[float] = []

    def evaluate() -> float:
        x.grad = None
        loss = cliff(x)
        loss.backward()
        losses.append(loss.item())
        return loss.item()

    for _ in range(STEPS):
        optimizer.step(evaluate)
        schedule.step()
    return losses


def steps_back(losses: list[float]) -> list[int]:
    """Evaluations that follow one beyond the cliff and are before it."""
    return [k for k in range(1, len(losses)) if losses[k - 1] > 5 and losses[k] < 5]


def test_steps_over_a_cliff_are_taken_back() -> None:
    plain = course(rough=False)
    assert max(plain) > 5 and min(plain[-20:]) > 5  # Adam goes over the cliff and stays there
    losses = course(rough=True)
    falls = steps_back(losses)
    assert len(falls) >= 3 and max(losses[-10:]) < 0.12
    for k in falls:
        assert losses[k] == min(losses[:k])  # the very parameters of the lowest loss
    assert min(b - a for a, b in zip(falls, falls[1:], strict=False)) >= PATIENCE


@pytest.mark.parametrize("at", range(2, 40, 3))
def test_an_interrupted_run_goes_on_as_it_would_have(at: int, tmp_path: Path) -> None:
    def problem(stop: int | None = None) -> Problem:
        x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
        calls = iter(range(1000))

        def loss() -> torch.Tensor:
            if next(calls) == stop:
                raise KeyboardInterrupt
            return cliff(x)

        return Problem("cliff", {"x": x}, [Stage(loss, STEPS, RATE, rough=True)], lambda: {"x": x.item()})

    with pytest.raises(KeyboardInterrupt):
        solve(problem(at), Settings(tmp_path))
    losses = [row["loss"] for row in solve(problem(), Settings(tmp_path)).history]
    assert losses == course(rough=True)
    assert min(steps_back(losses)) < 20 < max(steps_back(losses))


def test_what_cannot_be_rough_is_refused(tmp_path: Path) -> None:
    x = torch.zeros(1, requires_grad=True)

    def run(stage: Stage) -> None:
        solve(Problem("cliff", {"x": x}, [stage], lambda: {}), Settings(tmp_path))

    with pytest.raises(ValueError, match=r"stages\[0\].rough: expected False with an optimizer .*, got True"):
        run(Stage(lambda: cliff(x), 1, optimizer=torch.optim.SGD, rough=True))
    with pytest.raises(TypeError, match=r"stages\[0\].rough: expected a bool, got 'yes'"):
        run(Stage(lambda: cliff(x), 1, rough="yes"))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="rough: expected a loss that is not negative, got -1"):
        run(Stage(lambda: x.sum() - 1, 5, rough=True))


# --- the line at the end of a run -------------------------------------------------------------------------------------


def push(before: bool = False, rollout: bool = True) -> Problem:
    """Pushes a block until its end is at 0.1 m; the state counts the calls of the loss."""
    mesh = dv.mesh.box(2, 0.1)
    model = dv.Model(mesh)
    force = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    calls = torch.zeros((), dtype=torch.float64)
    x, way = model.rest_points, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    def loss() -> Tensor:
        calls.add_(1)
        if not rollout:
            return (force - 1).square()
        end = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(1 / 50, 3), mu=1e4, lam=1e4, steps=5, force=force * way,
                         gravity=(0, 0, 0), save="last").x[-1]  # fmt: skip
        return ((end - x)[:, 0].mean() - 0.1).square()

    stages = [Stage(loss, 6, optimizer=lambda p: torch.optim.LBFGS(p, 1, 6, line_search_fn="strong_wolfe"),
                    before=(lambda k: None) if before else None)]  # fmt: skip
    return Problem("push", {"force": force}, stages, lambda: {"force": force.item()}, state={"calls": calls})


def test_a_run_ends_with_the_line(tmp_path: Path) -> None:
    problem = push()
    result = solve(problem, Settings(tmp_path))
    found = result.refined
    # implicit Euler goes (n + 1) / n of the right way in n steps: smaller ones go less far
    assert isinstance(found, results.Refinement) and found.before == result.history[0]["loss"]
    assert found.loss < found.smaller_steps < result.history[0]["loss"]
    assert str(found) in table(problem, result).splitlines()[-1]
    assert str(found) in (tmp_path / "log.json").read_text(encoding="utf-8")
    assert float(problem.state["calls"]) <= len(result.history) + 1  # the four evaluations are not counted in


def test_or_with_why_not(tmp_path: Path) -> None:
    cases = {"quick": push(), "changes during the run": push(before=True), "runs dv.rollout": push(rollout=False)}
    for k, (words, problem) in enumerate(cases.items()):
        result = solve(problem, Settings(tmp_path / str(k), quick=words == "quick"))
        assert str(result.refined).startswith("not refined: ") and words in str(result.refined)


# --- captured evaluations ---------------------------------------------------------------------------------------------


@pytest.mark.cuda
def test_what_does_not_fit_a_graph_is_captured_again() -> None:
    x, room, calls = torch.tensor(0.5, device="cuda"), 1.0, []

    def run() -> Tensor:
        """x squared, as far as there is room; outside of a graph there is always."""
        nonlocal room
        calls.append(torch.cuda.is_current_stream_capturing())
        if not calls[-1] and float(x) > room:
            room = 2 * float(x)
        return torch.where(x <= room, x * x, torch.nan)

    replay = captured(run)
    for value, number in ((0.5, 3), (0.8, 3), (5.0, 5), (7.0, 5), (0.5, 5)):
        x.fill_(value)
        assert float(replay()) == pytest.approx(value * value)
        assert len(calls) == number  # warmed up twice and captured; later once and captured
    assert calls == [False, False, True, False, True]


@pytest.mark.cuda
def test_what_is_lost_outside_of_a_graph_is_returned() -> None:
    x = torch.tensor(1.0, device="cuda")
    replay = captured(lambda: x.log())
    assert float(replay()) == 0.0
    x.fill_(-1.0)
    assert torch.isnan(replay())
