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

from diffvbd.tasks import Problem, Settings, Stage, solve, table
from diffvbd.tasks.optimizer import Newton, lbfgs
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


@pytest.mark.parametrize("at", range(1, 23))
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


def test_findings_and_large_parameters_are_kept(tmp_path: Path) -> None:
    many = torch.zeros(2000, dtype=torch.float64, requires_grad=True)
    problem = Problem(
        "many", {"many": many}, [Stage(lambda: (many - 1).square().sum(), 3)], lambda: {"one": many[0].item()}
    )
    problem.findings = lambda history: {"rows": len(history), "nested": {"first": history[0]["loss"]}}
    result = solve(problem, Settings(tmp_path))
    log = json.loads((tmp_path / "log.json").read_text())
    assert log["findings"] == {"rows": 3, "nested": {"first": 2000.0}} == result.findings
    assert log["parameters"] == {}
    assert torch.equal(torch.load(tmp_path / "parameters.pt")["many"], many.detach())


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


def no_history(state: dict) -> None:
    state["history"] = []


def no_seconds(state: dict) -> None:
    del state["history"][1]["seconds"]


def late_stage(state: dict) -> None:
    state["stage"] = (7, 0, 0)


def no_optimizer(state: dict) -> None:
    del state["optimizer"]


def no_number(state: dict) -> None:
    state["parameters"]["a"].fill_(math.nan)


@pytest.mark.parametrize("damage", [no_history, no_seconds, late_stage, no_optimizer, no_number])
def test_a_damaged_state_is_put_aside_as_if_it_had_never_been(
    damage: Callable[[dict], None], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    expected = solve(toy(), Settings(tmp_path / "whole")).history
    first = toy()
    interrupt(first, 5)
    with pytest.raises(KeyboardInterrupt):
        solve(first, Settings(tmp_path / "run"))
    path = tmp_path / "run" / "state.pt"
    state = torch.load(path)
    damage(state)
    torch.save(state, path)
    (tmp_path / "run" / "state.other.pt").write_bytes(b"an earlier one")
    assert timeless(solve(toy(), Settings(tmp_path / "run")).history) == timeless(expected)
    assert "state.other-2.pt now; starting anew" in capsys.readouterr().err
    assert (tmp_path / "run" / "state.other.pt").read_bytes() == b"an earlier one"


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


def test_line_searches_of_lbfgs_have_room_to_end(tmp_path: Path) -> None:
    result = solve(wall(lbfgs), Settings(tmp_path))
    assert result.converged and not result.stalled


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


def test_a_step_that_moves_nothing_is_no_stall_where_the_loss_changes(tmp_path: Path) -> None:
    problem = wall(lambda p: torch.optim.SGD(p, lr=0.0))
    loss, numbers = problem.stages[0].loss, iter(range(60))
    problem.stages = [replace(problem.stages[0], loss=lambda: loss() + next(numbers), iterations=5)]
    result = solve(problem, Settings(tmp_path))
    assert len(result.history) == 5 and not result.stalled


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
