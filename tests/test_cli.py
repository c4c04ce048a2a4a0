"""The command line: what it writes, what it recovers, and how it refuses."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

import diffvbd as dv
from diffvbd.cli import main

SCENE = ["--steps", "12", "--time-step", "0.01", "--sweeps", "8", "--pin", "x-"]


@pytest.fixture
def mesh_file(tmp_path: Path) -> Path:
    path = tmp_path / "part.msh"
    dv.mesh.beam(5, 3, 3, size=(0.4, 0.1, 0.1)).save(path)
    return path


def run(*arguments: object) -> int:
    return main([str(a) for a in arguments])


def test_help_shows_examples_and_every_command(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for word in ("run", "list", "simulate", "identify", "info", "examples:", "--save-target"):
        assert word in text


def test_list_and_info(capsys: pytest.CaptureFixture) -> None:
    assert run("list") == 0
    assert "beam-mu-lam" in capsys.readouterr().out
    assert run("info") == 0
    text = capsys.readouterr().out
    assert "torch" in text and "_C" in text


def test_run_quick_prints_a_table_and_writes_its_files(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("run", "beam-mu", "--quick", "--out", tmp_path) == 0
    output = capsys.readouterr()
    assert "relative error" in output.out and "1e+06" in output.out
    assert "beam-mu [" in output.err and "|grad|" in output.err
    assert (tmp_path / "log.json").exists()


def test_simulate_writes_a_series_with_times(mesh_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.pvd"
    assert run("simulate", mesh_file, "--out", out, *SCENE, "--stride", 4, "--young", 1e5, "--poisson", 0.3) == 0
    sets = ElementTree.parse(out).getroot().findall("./Collection/DataSet")
    assert [float(s.get("timestep", "nan")) for s in sets] == pytest.approx([0.0, 0.04, 0.08, 0.12])
    last = dv.mesh.load(tmp_path / sets[-1].attrib["file"])
    rest = dv.mesh.load(mesh_file)
    pinned = rest.points[:, 0] < rest.points[:, 0].min() + 1e-9
    assert np.array_equal(last.points[pinned], rest.points[pinned])
    assert last.points[:, 1].min() < rest.points[:, 1].min() - 1e-3


def test_young_and_poisson_mean_their_lame_parameters(mesh_file: Path, tmp_path: Path) -> None:
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    materials = (["--young", 1.3e5, "--poisson", 0.3], ["--mu", 5e4, "--lam", 7.5e4])
    for file, material in zip(files, materials, strict=True):
        arguments = ["--out", tmp_path / "part.pvd", *SCENE, *material, "--save-target", file]
        assert run("simulate", mesh_file, *arguments) == 0
    a, b = (dict(np.load(file)) for file in files)
    assert (a["mu"], a["lam"]) == (pytest.approx(5e4), pytest.approx(7.5e4))
    np.testing.assert_allclose(a["x"], b["x"], rtol=0, atol=1e-12)


def test_floor_holds(mesh_file: Path, tmp_path: Path) -> None:
    target = tmp_path / "drop.npz"
    floor = dv.mesh.load(mesh_file).points[:, 1].min() - 0.01
    arguments = ["--floor", floor, "--dhat", 0.005, "--steps", 20, "--velocity", 0.5, -2.0, 0.0]
    assert run("simulate", mesh_file, "--out", tmp_path / "drop.pvd", *arguments, "--save-target", target) == 0
    x = np.load(target)["x"]
    assert x[..., 1].min() > floor
    assert x[-1, :, 0].mean() > x[0, :, 0].mean()


def test_identify_recovers_the_material_of_a_motion(mesh_file: Path, tmp_path: Path, capsys) -> None:
    target = tmp_path / "target.npz"
    material = ["--mu", 4e4, "--lam", 6e4, "--velocity", 0, 2, 0]
    assert run("simulate", mesh_file, "--out", tmp_path / "a.pvd", *SCENE, *material, "--save-target", target) == 0
    options = ["--start", 1e4, 1e4, "--out", tmp_path / "run"]
    assert run("identify", mesh_file, target, *options) == 0
    errors = [
        line.split()[4] for line in capsys.readouterr().out.splitlines() if line.strip().startswith(("mu", "lam"))
    ]
    assert len(errors) == 2
    assert all(float(error) < 0.01 for error in errors)  # [%]


def test_identify_from_one_final_shape(mesh_file: Path, tmp_path: Path) -> None:
    target = tmp_path / "target.npz"
    assert run("simulate", mesh_file, "--out", tmp_path / "a.pvd", *SCENE, "--mu", 4e4, "--save-target", target) == 0
    content = dict(np.load(target))
    np.savez(tmp_path / "shape.npz", x=content["x"][-1])
    options = ["--start", 1e4, 1e5, "--fixed-lam", "--out", tmp_path / "run"]
    assert run("identify", mesh_file, tmp_path / "shape.npz", *SCENE, *options) == 0
    log = (tmp_path / "run" / "log.json").read_text()
    mu = float(log.split('"estimates": {')[1].split('"mu": ')[1].split(",")[0])
    assert mu == pytest.approx(4e4, rel=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["simulate", "missing.msh", "--out", "a.pvd"], "missing.msh"),
        (["simulate", "MESH", "--out", "a.txt"], ".pvd"),
        (["simulate", "MESH", "--out", "a.pvd", "--pin", "w-"], "--pin"),
        (["simulate", "MESH", "--out", "a.pvd", "--pin", "x-:2"], "--pin"),
        (["simulate", "MESH", "--out", "a.pvd", "--stride", "0"], "--stride"),
        (["simulate", "MESH", "--out", "a.pvd", "--young", "1e5"], "--poisson"),
        (["simulate", "MESH", "--out", "a.pvd", "--young", "1e5", "--poisson", "0.5"], "--poisson"),
        (["simulate", "MESH", "--out", "a.pvd", "--mu=-1"], "mu"),
        (["simulate", "MESH", "--out", "a.pvd", "--time-step", "0"], "time_step"),
        (["identify", "MESH", "missing.npz"], "missing.npz"),
        (["identify", "MESH", "MESH"], "expected an .npz file"),
        (["identify", "MESH", "SHAPE"], "--steps"),
        (["identify", "MESH", "WRONG", "--steps", "3"], "x: expected finite values of shape [N, 45, 3]"),
        (["identify", "MESH", "SHAPE", "--steps", "3", "--start", "0", "1"], "start"),
    ],
)
def test_an_error_is_one_clear_line_and_status_2(
    arguments: list[str], message: str, mesh_file: Path, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("shape.npz", x=dv.mesh.load(mesh_file).points)
    np.savez("wrong.npz", x=np.zeros((3, 4, 3)))
    names = {"MESH": mesh_file, "SHAPE": "shape.npz", "WRONG": "wrong.npz"}
    assert run(*(names.get(a, a) for a in arguments)) == 2
    error = capsys.readouterr().err
    assert error.startswith("diffvbd: error: ") and error.count("\n") == 1
    assert message in error


def test_wrong_usage_has_status_2() -> None:
    for arguments in ([], ["run", "nothing"], ["simulate", "part.msh"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
