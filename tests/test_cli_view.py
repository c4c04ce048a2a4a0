"""Claim: `diffvbd view` shows files and runs, `diffvbd run --view` shows a run and changes no result."""

import json
from pathlib import Path
from typing import Any

import pytest

import diffvbd as dv
from diffvbd import cli

pytest.importorskip("viser")


def test_view_serves_a_file_until_it_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    dv.mesh.cube(3, 0.2).save(tmp_path / "part.vtu")
    seen: list[str] = []

    def stop(viewer: dv.viz.Viewer) -> None:
        seen.append(viewer.url)
        raise KeyboardInterrupt

    monkeypatch.setattr(dv.viz.Viewer, "wait", stop)
    assert cli.main(["view", str(tmp_path / "part.vtu"), "--port", "8111"]) == 0
    assert seen[0] in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["none.pvd"], "none.pvd does not exist"),
        (["part.vtu", "--color", "stress"], "color: stress needs a dv.Model, or a mesh with mu and lam"),
        (
            ["part.glb"],
            "a mesh with tets or the folder of a run; .glb is for other programs",
        ),
        (["part.vtu", "--time-step", "-1"], "time_step: expected"),
    ],
)
def test_view_says_what_is_wrong(
    arguments: list[str], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    dv.mesh.cube(3, 0.2).save("part.vtu")
    Path("part.glb").touch()
    monkeypatch.setattr(dv.viz.Viewer, "wait", lambda viewer: None)
    assert cli.main(["view", *arguments]) == 2
    assert expected in capsys.readouterr().err


def test_a_run_that_is_viewed_finds_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    shown: list[tuple[Any, ...]] = []
    update = dv.viz.Viewer.update

    def counted(self: dv.viz.Viewer, x: Any = None, loss: Any = None, **parameters: Any) -> None:
        shown.append((None if x is None else tuple(x.x.shape), loss, *parameters))
        update(self, x, loss, **parameters)

    monkeypatch.setattr(dv.viz.Viewer, "update", counted)
    for name, more in (("plain", []), ("viewed", ["--view", "--port", "8112"])):
        assert cli.main(["run", "beam-mu", "--quick", "--out", str(tmp_path / name), *more]) == 0
    assert "live view at http://127.0.0.1:" in capsys.readouterr().err
    plain, viewed = (json.loads((tmp_path / name / "log.json").read_text())["history"] for name in ("plain", "viewed"))
    assert [row | {"seconds": 0} for row in plain] == [row | {"seconds": 0} for row in viewed]
    assert len(shown) == len(viewed) and shown[0] == ((16, 54, 3), viewed[0]["loss"], "gradient_norm", "mu")
    names = [*dv.viz.motion.opened(tmp_path / "viewed").motions]  # pyright: ignore[reportAttributeAccessIssue]
    assert names == ["initial", "target", "recovered"]
