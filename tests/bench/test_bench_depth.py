"""Claim: the study of solver depth optimises every throw as if it were alone, and its statistics are Welch's."""

import json
import math
import statistics
from pathlib import Path

import pytest
import torch

from bench import depth, paper
from bench.__main__ import main
from diffvbd.tasks import Settings, bounce, solve
from diffvbd.testing import tolerance


@pytest.mark.slow
def test_quick_run_brings_every_throw_closer(tmp_path: Path) -> None:
    assert main(["depth", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "depth.json").read_text())["results"]
    assert [row["sweeps"] for row in results["depths"]] == [5, 20]
    for row in results["depths"]:
        assert len(row["starts"]) == len(row["distances"]) == 2
        assert all(0 < end < 0.8 * start for start, end in zip(row["starts"], row["distances"], strict=True))
        assert row["min"] <= row["median"] <= row["max"] and row["std"] > 0
    few, many = results["depths"]
    # the quick run's judge has 20 sweeps: it agrees with itself and not with five
    assert many["converged"] == pytest.approx(many["median"], rel=tolerance("six_digits"))
    assert abs(few["converged"] - few["median"]) > 1e-5
    text = (tmp_path / "depth.md").read_text()
    assert "| 5 | 20 |" in text and "| paper, mean |" in text and "| 0.052 |" in text


def test_page_says_what_its_numbers_say() -> None:
    """Depth that helps the mean and narrows the spread, and depth that does neither."""

    def said(many: list[float]) -> str:
        rows = [{"sweeps": k, "distances": d, "std": statistics.stdev(d), "unsolved": 1e-3}
                for k, d in ((5, [0.15, 0.2, 0.25]), (100, many))]  # fmt: skip
        return depth.verdict(rows, [{"sweeps": [5, 100], **depth.welch(rows[0]["distances"], many)}])

    better, same = said([0.010, 0.012, 0.011]), said([0.15, 0.2, 0.25])
    assert "5 and 100 sweeps differ" in better and "the effect is there" in better
    assert "no difference" in same and "the effect is absent" in same
    assert depth.bound(14) == pytest.approx(2.145, abs=tolerance("student_table"))  # of Student's table


def test_throw_of_a_batch_moves_as_if_alone(tmp_path: Path) -> None:
    scene = bounce.scene(Settings(tmp_path), sweeps=5)
    batch = depth.Batch(scene, depth.first_states(1))
    batch.problem(2).stages[0].loss().backward()
    problem = bounce.cube_bounce(Settings(tmp_path), sweeps=5)
    problem.stages[0].loss().backward()
    alone = [problem.parameters[name] for name in ("offset", "velocity")]
    norm = torch.nn.utils.clip_grad_norm_(alone, bounce.CLIP)
    assert norm > 1.05 * bounce.CLIP
    states = torch.stack([p.grad for p in alone if p.grad is not None])
    assert batch.states.grad is not None
    # clip_grad_norm_ adds 1e-6 to the norm
    assert torch.allclose(batch.states.grad[0], states, rtol=tolerance("six_digits"), atol=0.0)
    assert batch.distances[0].item() == pytest.approx(problem.estimates()["distance"], rel=tolerance("cancelling"))


def test_best_state_of_each_throw_is_kept(tmp_path: Path) -> None:
    scene = bounce.scene(Settings(tmp_path), sweeps=5)
    batch = depth.Batch(scene, depth.first_states(1))
    history = solve(batch.problem(2), Settings(tmp_path)).history
    least = torch.tensor([min(row[f"distance {k}"] for row in history) for k in range(2)], dtype=torch.float64)
    with torch.no_grad():
        again = scene.squared_miss(*batch.best.unbind(1)).sqrt()
    assert torch.equal(batch.least, least) and torch.allclose(again, least, rtol=tolerance("cancelling"), atol=0.0)


def test_first_states_are_relative(tmp_path: Path) -> None:
    own, *others = depth.first_states(8)
    assert own[0].tolist() == [0.0, 0.0, 0.0] and tuple(own[1].tolist()) == bounce.VELOCITY
    offsets, velocities = torch.stack(others).unbind(1)
    assert (offsets[:, [0, 2]] == 0).all() and (offsets[:, 1] != 0).all()
    spread = (velocities / own[1] - 1).std().item()
    assert 0.7 * depth.JITTER < spread < 1.3 * depth.JITTER


def test_welch_is_that_of_scipy_and_of_the_paper() -> None:
    stats = pytest.importorskip("scipy.stats")
    a, b = [0.1, 0.4, 0.2, 0.35], [0.2, 0.9, 0.3, 0.8, 0.75]
    expected = stats.ttest_ind(a, b, equal_var=False)
    got = depth.welch(a, b)
    assert (got["t"], got["df"]) == pytest.approx((expected.statistic, expected.df), rel=tolerance("cancelling"))

    def sample(mean: float, std: float) -> list[float]:
        return [mean + sign * std * math.sqrt(7 / 8) for sign in (1, -1)] * 4

    # the paper gives mean and standard deviation to two digits
    for (few, many), t in paper.DEPTH_T.items():
        pair = [sample(paper.DEPTH[k]["mean"], paper.DEPTH[k]["std"]) for k in (few, many)]
        assert abs(depth.welch(*pair)["t"]) == pytest.approx(t, abs=tolerance("two_digits"))
