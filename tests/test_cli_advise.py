"""Claim: `diffvbd advise` prints settings to use, and says which options do not go together."""

import re
from pathlib import Path

import pytest

import diffvbd as dv
from diffvbd.cli import main


@pytest.fixture
def mesh_file(tmp_path: Path) -> Path:
    path = tmp_path / "part.msh"
    dv.mesh.save(path, dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1)))
    return path


def test_advise(mesh_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["advise", str(mesh_file), "--pin", "x-", "--duration", "0.1", "--error", "0.1"]
    assert main(common) == 0
    told = capsys.readouterr().out
    made = re.search(r"in Python: settings=(dv\.Settings\(.*\))", told)
    assert made is not None and "pilot runs took" in told
    settings = eval(made[1])
    assert isinstance(settings, dv.Settings) and 0 < settings.time_step <= 0.1
    assert main([*common, "--sweeps", "3"]) == 2
    assert "--sweeps: expected none" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["advise", "--help"])
    shown = capsys.readouterr().out
    assert "--sweeps" not in shown and "--time-step" not in shown and "--floor" in shown


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--kappa", "100"], "--kappa: expected --floor beside it"),
        (["--friction", "0.5"], "--friction: expected --floor beside it"),
        (["--floor", "nan"], "--floor: expected finite numbers, got nan"),
        (["--gravity", "0", "inf", "0"], "--gravity: expected finite numbers"),
    ],
)
def test_options_of_a_scene(mesh_file: Path, options: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["advise", str(mesh_file), "--duration", "0.1", *options]) == 2
    assert said in capsys.readouterr().err
