"""Claim: `python -m bench tradeoff` holds every way against one reference and finds the fronts of what it has run."""

import math

import torch

import diffvbd as dv
from bench import plots, tradeoff
from bench.tradeoff import best, front_of, others_of
from bench.tradeoff_peers import LAW, against_itself, converged
from bench.tradeoff_scenes import SCENES, cantilever


def test_a_quick_run() -> None:
    results = tradeoff.run(quick=True, only="cloth")
    group = results["cloth"]
    rows = group["rows"]
    assert len(rows) > 4 and all(math.isfinite(row["error"]) and row["ms"] > 0 for row in rows)
    assert group["unsure"] < 0.5
    # shorter steps come closer, and gradients are of their own
    assert min(row["error"] for row in rows) < 0.5 * rows[0]["error"]
    assert any(row["gradient_error"] != row["error"] for row in rows)
    assert [told["asked"] for told in group["advised"]] == list(tradeoff.ERRORS)
    text = tradeoff.markdown(results)
    assert "| implicit Euler |" in text and f"{group['vertices']} vertices" in text


def test_fronts() -> None:
    rows = [{"way": str(k), "error": e, "ms": t} for k, (e, t) in enumerate([(1e-1, 1.0), (2e-1, 2.0), (1e-3, 3.0)])]
    rows.append({"way": "failed", "error": "inf", "ms": 0.5})  # as JSON has it
    assert [row["way"] for row in front_of(rows)] == ["0", "2"]
    chosen = best(rows, 0.01)
    assert chosen is not None and chosen["way"] == "2" and best(rows, 1e-4) is None
    named = [row | {"solver": "one", "note": ""} for row in rows]
    assert others_of(named) == [["one", 1.0, 3.0, 3.0, 1e-3, 3.0, ""]]


def test_every_scene_moves() -> None:
    for name, build in SCENES.items():
        scene = build()
        runs = tradeoff.pilots_of(dv.rollout, scene.model, scene.model.rest_points, scene.v, scene.duration, None,
                                  False, scene.given)  # fmt: skip
        run = runs.run(dv.Settings(1.0, 8), 64)
        assert run.x is not None, name
        assert float(runs.motion(run.x)) > 1e-3 * runs.size, name


def test_other_solvers_come_closer_with_shorter_steps() -> None:
    scene = cantilever(1e4)
    rows = converged(scene, lambda frames: float((frames[-1] - scene.model.rest_points).norm()), 1)
    assert rows[0]["error"] > 0.1  # the distance here is the motion itself

    def free_fall(x: torch.Tensor, v: torch.Tensor, h: float, iterations: int) -> tuple[torch.Tensor, torch.Tensor]:
        v = v - h * 9.81
        return x + h * v, v

    rows = against_itself("falls", free_fall, scene, (1,), 2)
    assert [row["steps"] for row in rows] == [4, 8, 16] and rows[0]["note"] == LAW
    assert rows[2]["error"] < 0.5 * rows[0]["error"]


def test_the_picture(tmp_path) -> None:
    rows = [{"way": "SDIRK2", "sweeps": 5, "steps": n, "ms": float(n), "error": 1 / n**2} for n in (4, 8)]
    results = {"soft": {"scene": "soft", "rows": rows, "advised": [], "unsure": 1e-3}}
    assert plots.draw("tradeoff", results, tmp_path / "fronts.png")
    assert (tmp_path / "fronts.png").stat().st_size > 1000
