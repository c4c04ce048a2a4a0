"""Claim: what `bench stifftasks` says of rigid and coarse corrections holds, and tasks have the settings it keeps."""

from pathlib import Path

import pytest

from bench import stifftasks
from bench.stifftasks_scenes import TASKS as MOTIONS
from bench.stifftasks_scenes import bodies
from diffvbd.tasks import TASKS, Settings
from diffvbd.testing import tolerance


def test_the_rigid_correction_keeps_momentum_and_the_coarse_ones_find_the_shape() -> None:
    spinning, _, cantilever = bodies(True)[3:]
    rows = {(row["sweeps"], row["rigid"], row["coarse"]): row for row in stifftasks.of_body(spinning, True)}
    assert len(rows) == 8
    for (_, rigid, _), row in rows.items():
        for name in ("momentum", "angular_momentum"):
            assert row[name] < tolerance("sum") if rigid else row[name] > 1e-4
    for sweeps in (4, 10):
        both = rows[sweeps, True, "auto"]["error"]
        assert both < rows[sweeps, True, "off"]["error"] and both < rows[sweeps, False, "auto"]["error"]
    plain, coarse = (r for r in stifftasks.of_body(cantilever, True) if r["sweeps"] == 10)
    assert plain["momentum"] is None and coarse["error"] < 0.1 * plain["error"]


@pytest.mark.slow
def test_tasks_have_the_settings_that_are_kept(tmp_path: Path) -> None:
    for make, ways in MOTIONS:
        (kept,) = (way for way, verdict in ways if verdict.startswith(("kept", "stays")))
        protocol = TASKS[make(True).name].build(Settings(tmp_path)).protocol
        assert protocol["time_step"] == kept.time_step and protocol["sweeps"] == kept.sweeps
        assert protocol.get("relaxation", 1.0) == kept.relaxation and protocol.get("coarse") == kept.coarse
