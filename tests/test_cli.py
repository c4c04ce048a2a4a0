"""The command line: what it writes, what it recovers, and how it refuses."""

import io
import json
import re
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd import cli
from diffvbd import mesh as dm
from diffvbd.cli import main
from diffvbd.tasks import folder as archive
from diffvbd.tasks.folder import alone_in
from diffvbd.tasks.identify import Observation
from diffvbd.testing import tolerance

SCENE = ["--steps", "12", "--time-step", "0.01", "--sweeps", "8", "--pin", "x-"]


@pytest.fixture
def mesh_file(tmp_path: Path) -> Path:
    path = tmp_path / "part.msh"
    dv.mesh.beam(5, 3, 3, size=(0.4, 0.1, 0.1), split="kuhn").save(path)
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
    assert rest.points[:, 1].min() - last.points[:, 1].min() > 1e-3


def test_young_and_poisson_mean_their_lame_parameters(mesh_file: Path, tmp_path: Path) -> None:
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    materials = (["--young", 1.3e5, "--poisson", 0.3], ["--mu", 5e4, "--lam", 7.5e4])
    for file, material in zip(files, materials, strict=True):
        arguments = ["--force", "--out", tmp_path / "part.pvd", *SCENE, *material, "--save-target", file]
        assert run("simulate", mesh_file, *arguments) == 0
    a, b = (dict(np.load(file)) for file in files)
    assert (a["mu"], a["lam"]) == (pytest.approx(5e4), pytest.approx(7.5e4))
    np.testing.assert_allclose(a["x"], b["x"], rtol=0, atol=tolerance("cancelling"))


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


def test_without_a_command_the_help_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 2
    told = capsys.readouterr().out
    assert "identify  recover mu and lam" in told and "examples:" in told


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
        (["simulate", "MESH", "--out", "a.pvd", "--device", "bogus"], "device: expected one of this machine"),
        (["simulate", "MESH", "--out", "a.pvd", "--steps", str(2**62)], "--steps: expected an integer from 0 to"),
        (["simulate", "MESH", "--out", "a.pvd", "--steps", "-1"], "--steps"),
        (["simulate", "MESH", "--out", "a.pvd", "--friction", "0.5"], "--friction: expected --floor with it"),
        (["simulate", "MESH", "--out", "a.pvd", "--relaxation", "2"], "relaxation"),
        (["simulate", "MESH", "--out", "there.pvd"], "there.pvd would be overwritten; give --force"),
        (["simulate", "MESH", "--out", "frames.pvd"], "frames_0003.vtu would be overwritten; give --force"),
        (["simulate", "MESH", "--out", "new.pvd", "--save-target", "shape.npz"], "shape.npz would be overwritten"),
        (["simulate", "frames_0003.vtu", "--out", "frames.pvd", "--force"], "would overwrite frames_0003.vtu"),
        (["simulate", "MESH", "--out", "a.pvd", "--force", "--save-target", "MESH"], "--save-target: expected a file"),
        (["identify", "MESH", "SHAPE", "--device", "bogus", "--steps", "3"], "device: expected one of this machine"),
        (["identify", "MESH", "SHAPE", "--steps", str(2**62)], "--steps: expected an integer from 0 to 10000000"),
        (["identify", "MESH", "SHAPE", "--steps", "3", "--start-young", "1e5"], "--start-poisson"),
        (["identify", "MESH", "SHAPE", "--steps", "3", "--start-young", "1e5", "--start-poisson", "0.6"], "poisson"),
        (["identify", "MESH", "SHAPE", "--steps", "3", "--start", "1", "1", "--start-young", "1"], "--start"),
        (["identify", "MESH", "SHAPE", "--steps", "3", "--start", "nan", "1"], "start"),
        (["identify", "MESH", "other.npz"], "unknown keys ['positions']: expected x and any of density, dhat, floor"),
        (["identify", "MESH", "mm.npz"], "x: expected shapes about as large as the mesh, 0.4 m, got 400 m"),
        (
            ["identify", "MESH", "timed.npz", "--time-step", "0.04"],
            "time_step: expected 0.03 s, or that over",
        ),
        (["identify", "MESH", "none.npz"], "x: expected at least one observed shape, got none"),
        (["identify", "MESH", "decreasing.npz"], "steps: expected 2 increasing integers from 0 to 10000000"),
        (["identify", "MESH", "far.npz"], "the last >= 1, got 1 to 4611686018427387904"),
        (["identify", "MESH", "sweeps.npz"], "sweeps: expected an integer, got [3, 4]"),
        (["identify", "MESH", "gravity.npz"], "gravity: expected finite numbers of shape [3], got -9.81"),
        (["identify", "MESH", "pinned.npz"], "pinned: expected bool of shape [45], got [0, 3]"),
        (["identify", "MESH", "words.npz"], "x: expected numbers, got dtype <U4"),
        (["identify", "MESH", "claims.npz"], "claims.npz: expected an .npz file"),
        (["identify", "MESH", "cut.npz"], "cut.npz: expected an .npz file"),
        (["identify", "MESH", "bomb.npz"], "expected at most 1000000 bytes of arrays, got 8000128 when unpacked"),
        (["identify", "MESH", "missing.npz"], "missing.npz"),
        (["identify", "MESH", "MESH"], "expected an .npz file"),
        (["identify", "MESH", "SHAPE"], "--steps"),
        (["identify", "MESH", "WRONG", "--steps", "3"], "x: expected shape [N, 45, 3]"),
        (["identify", "MESH", "SHAPE", "--steps", "3", "--start", "0", "1"], "start"),
    ],
)
def test_an_error_is_one_clear_line_and_status_2(
    arguments: list[str], message: str, mesh_file: Path, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("shape.npz", x=dv.mesh.load(mesh_file).points)
    np.savez("wrong.npz", x=np.zeros((3, 4, 3)))
    damaged_targets(dv.mesh.load(mesh_file).points)
    monkeypatch.setattr(archive, "MOST_BYTES", 10**6)
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))  # no terminal: not asked
    Path("there.pvd").touch()
    dv.mesh.load(mesh_file).save("frames_0003.vtu")
    kept = {path: path.read_bytes() for path in tmp_path.iterdir()}
    names = {"MESH": mesh_file, "SHAPE": "shape.npz", "WRONG": "wrong.npz"}
    assert run(*(names.get(a, a) for a in arguments)) == 2
    error = capsys.readouterr().err
    assert error.startswith("diffvbd: error: ") and error.count("\n") == 1
    assert message in error
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == kept


def damaged_targets(points: np.ndarray) -> None:
    """Targets that are almost right, in the present folder."""
    two = np.stack([points, points + 0.1])
    np.savez("none.npz", x=two[:0])
    np.savez("other.npz", positions=two)
    np.savez("mm.npz", x=1000.0 * two)
    np.savez("timed.npz", x=two, steps=[3, 6], time_step=0.01)
    np.savez("decreasing.npz", x=two, steps=np.array([5, 3], dtype=np.uint64))
    np.savez("far.npz", x=two, steps=np.array([1, 2**62]))
    np.savez("sweeps.npz", x=two, sweeps=[3, 4])
    np.savez("gravity.npz", x=two, gravity=-9.81)
    np.savez("pinned.npz", x=two, pinned=[0, 3])
    np.savez("words.npz", x=np.array(["soft"]))
    np.savez_compressed("bomb.npz", x=np.zeros(10**6))
    Path("cut.npz").write_bytes(Path("none.npz").read_bytes()[:-40])
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (2**50,)})
    with zipfile.ZipFile("claims.npz", "w") as file:
        file.writestr("x.npy", header.getvalue() + bytes(80))


def test_simulate_makes_folders_and_asks_before_it_overwrites(
    mesh_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    out, target = tmp_path / "a" / "b" / "part.pvd", tmp_path / "c" / "target.npz"
    arguments = ["simulate", mesh_file, "--out", out, "--save-target", target, *SCENE]
    assert run(*arguments) == 0
    first = target.read_bytes()
    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr("sys.stdin", terminal)
    asked: list[str] = []
    for answer, status in (("n", 2), ("", 2), ("y", 0)):
        monkeypatch.setattr("builtins.input", lambda text, answer=answer: asked.append(text) or answer)
        assert run(*arguments, "--mu", 5e4) == status
        assert (target.read_bytes() == first) == (status == 2)
    assert len(asked) == 3 and all(f"overwrite {out} and 14 more?" in text for text in asked)
    assert "nothing was written" in capsys.readouterr().err
    assert run(*arguments, "--force") == 0 and len(asked) == 3


def test_coarse_corrections_are_part_of_the_scene(mesh_file: Path, tmp_path: Path) -> None:
    """With two sweeps they change where a stiff body ends, and its file says that they were there."""
    ends = {}
    for name, more in {"plain": [], "coarse": ["--subspace", "coarse"]}.items():
        target = tmp_path / f"{name}.npz"
        out = ["--out", tmp_path / f"{name}.pvd", "--save-target", target, "--pin", "x-"]
        assert (
            run("simulate", mesh_file, *out, "--young", 1e6, "--poisson", 0.3, "--sweeps", 2, "--steps", 6, *more) == 0
        )
        found = Observation.load(target, dv.mesh.load(mesh_file))
        assert found.scene.subspace == ("coarse" if name == "coarse" else "rigid")
        ends[name] = found.x[-1]
    apart = np.abs(ends["coarse"] - ends["plain"]).max()
    assert apart > 0.05 * np.abs(ends["plain"] - found.x[0]).max()
    out = ["--iterations", 1, "--out", tmp_path / "run"]
    assert run("identify", mesh_file, tmp_path / "plain.npz", "--subspace", "coarse", *out) in (0, 1)
    asked = Observation.load(tmp_path / "plain.npz", dv.mesh.load(mesh_file), subspace="coarse")
    assert asked.scene.solver.subspace == dv.CoarseSpace()
    with pytest.raises(ValueError, match="subspace: expected one of .*, got 'fine'"):
        Observation.load(tmp_path / "plain.npz", dv.mesh.load(mesh_file), subspace="fine")


@pytest.mark.parametrize(
    ("rate", "status", "message"),
    [(0.0, 1, "warning: identify stalled: "), (1e-3, 0, "warning: identify did not converge in 3 evaluations: ")],
)
def test_identify_says_where_it_did_not_converge(
    rate: float, status: int, message: str, mesh_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    target = tmp_path / "target.npz"
    assert run("simulate", mesh_file, "--out", tmp_path / "a.pvd", *SCENE, "--mu", 4e4, "--save-target", target) == 0
    monkeypatch.setattr(torch.optim, "LBFGS", lambda parameters, **_: torch.optim.SGD(parameters, lr=rate))
    options = ["--start", 1e4, 1e4, "--iterations", 3, "--out", tmp_path / "run"]
    assert run("identify", mesh_file, target, *options) == status
    output = capsys.readouterr()
    assert message in output.err and "Young's modulus" in output.out


@pytest.mark.slow
def test_two_runs_do_not_share_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "run"
    code = "import sys; from pathlib import Path; from diffvbd.tasks.folder import alone_in\n"
    code += "with alone_in(Path(sys.argv[1])): print('in', flush=True); sys.stdin.read()"
    other = subprocess.Popen(
        [sys.executable, "-c", code, out], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout is not None and other.stdout.readline() == "in\n"
        assert run("run", "beam-mu", "--quick", "--out", out) == 2
        error = capsys.readouterr().err
        assert error.startswith("diffvbd: error: out: expected a folder that no other run works in")
        assert error.count("\n") == 1 and list(out.iterdir()) == []
    finally:
        other.kill()  # as a crash: nothing is cleaned up
        other.communicate()
    with alone_in(out):
        pass
    assert list(out.iterdir()) == []


def test_wrong_usage_has_status_2() -> None:
    for arguments in (["run", "nothing"], ["simulate", "part.msh"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2


def test_a_warning_is_one_line_without_a_place(mesh_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No line of a program is its cause, and Python's own would be that of its start."""
    said: list[str] = []
    shown = warnings.formatwarning
    monkeypatch.setattr(
        cli, "_simulate", lambda options: said.append(warnings.formatwarning("sweeps:\n few", UserWarning, "a.py", 3))
    )
    assert run("simulate", mesh_file, "--out", "part.pvd") == 0
    assert said == ["warning: sweeps: few\n"] and warnings.formatwarning is shown


# --- `diffvbd advise` prints settings to use, and says which options do not go together ---


@pytest.fixture
def beam_file(tmp_path: Path) -> Path:
    path = tmp_path / "part.msh"
    dv.mesh.save(path, dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1)))
    return path


def test_advise(beam_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["advise", str(beam_file), "--pin", "x-", "--duration", "0.1", "--error", "0.1"]
    assert main(common) == 0
    told = capsys.readouterr().out
    made = re.search(r"in Python: (dv\.VBD\(.*\))", told)
    assert made is not None and "trial runs took" in told
    solver = eval(made[1])
    assert isinstance(solver, dv.VBD) and 0 < solver.time_step <= 0.1
    assert main([*common, "--sweeps", "3"]) == 2
    assert "--sweeps: expected none" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["advise", "--help"])
    shown = capsys.readouterr().out
    assert "--sweeps" not in shown and "--time-step" not in shown and "--floor" in shown


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--kappa", "100"], "--kappa: expected --floor with it"),
        (["--friction", "0.5"], "--friction: expected --floor with it"),
        (["--floor", "nan"], "--floor: expected finite numbers, got nan"),
        (["--gravity", "0", "inf", "0"], "--gravity: expected finite numbers"),
    ],
)
def test_options_of_a_scene(beam_file: Path, options: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["advise", str(beam_file), "--duration", "0.1", *options]) == 2
    assert said in capsys.readouterr().err


# --- `diffvbd mesh` makes tets of a scan, shows what it found, and writes over nothing unasked ---


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """A box in cm that stands on its z axis, as a .ply file."""
    box = dm.box(3, (10.0, 10.0, 20.0))
    meshio.Mesh(box.points, [("triangle", box.surface.astype(np.int32))]).write(tmp_path / "scan.ply")
    return tmp_path / "scan.ply"


def test_a_scan_becomes_tets(scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for package in ("pytetwild", "pyvista", "trimesh"):
        pytest.importorskip(package, reason="needs the extra [mesh]")
    part = tmp_path / "part.msh"
    assert run("mesh", scan, "--size", 0.2, "--up", "z", "--edge", 0.05, "-o", part) == 0
    told = capsys.readouterr().out
    for words in (
        "0.1 x 0.2 x 0.1 m (x, y, z; y is up), 0.01 m per unit",
        "closed",
        "quality",
        "median",
        f"wrote {part}",
    ):
        assert words in told
    mesh = dm.load(part)
    assert np.ptp(mesh.points, axis=0) == pytest.approx([0.1, 0.2, 0.1], rel=tolerance("meshed_anew"))
    np.testing.assert_allclose(mesh.volume.sum(), 2e-3, rtol=tolerance("meshed_anew"))
    assert "decimated" not in told
    assert run("mesh", scan, "-o", part) == 2
    assert "would be overwritten; give --force, or another name" in capsys.readouterr().err


def test_a_scan_without_its_unit_is_warned_of(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    monkeypatch.setattr(dm, "tetrahedralize", lambda *given: dm.cube(3))
    with pytest.warns(
        UserWarning, match=r"largest extent is 20 m.* scale=0\.001 \(--scale 0\.001\), or size= \(--size\)"
    ):
        assert run("mesh", scan, "-o", scan.with_name("part.vtu")) == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["-o", "part.stl"], "--out: expected a name that ends in .msh, .vtu, .vtk, .mesh, .inp, got part.stl"),
        (["-o", "nowhere/part.msh"], "directory nowhere does not exist"),
        (["-o", "scan.ply"], "--out: expected another file than scan.ply"),
    ],
)
def test_refusals_are_one_line(
    scan: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(scan.parent)
    assert run("mesh", scan.name, *arguments) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1


def test_simulate_writes_gltf_and_says_early_what_usd_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    dm.beam(3, 2, 2).save(tmp_path / "part.msh")
    common = ["simulate", tmp_path / "part.msh", "--steps", 2, "--pin", "x-:0.1"]
    (tmp_path / "part_0000.vtu").touch()  # of a series of the same name, which is not written here
    assert run(*common, "--out", tmp_path / "part.glb") == 0
    assert (tmp_path / "part.glb").read_bytes()[:4] == b"glTF"
    monkeypatch.setitem(sys.modules, "pxr", None)
    monkeypatch.setattr("diffvbd.cli._scene", lambda *_: pytest.fail("simulated first"))
    assert run(*common, "--out", tmp_path / "part.usdc") == 2
    assert "pip install 'diffvbd[exchange]'" in capsys.readouterr().err
    assert run(*common, "--out", tmp_path / "part.avi") == 2
    assert "--out: expected a name that ends in .pvd, .usd" in capsys.readouterr().err


# --- `diffvbd view` shows files and runs, `diffvbd run --view` shows a run and changes no result ---


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


@pytest.mark.slow
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
