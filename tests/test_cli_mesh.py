"""Claim: `diffvbd mesh` makes tets of a scan, shows what it found, and writes over nothing unasked; `diffvbd simulate`
writes motions for other programs."""

import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

from diffvbd import cli
from diffvbd import mesh as dm
from diffvbd.cli import main
from diffvbd.testing import tolerance


def run(*arguments: object) -> int:
    return main([str(a) for a in arguments])


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


def test_what_is_left_out_of_a_large_scan_is_said(
    scan: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    monkeypatch.setattr(dm, "tetrahedralize", lambda surface, edge, epsilon, most: dm.cube(3))
    assert run("mesh", scan, "--scale", 0.01, "--max-triangles", 20, "-o", scan.with_name("part.vtu")) == 0
    told = capsys.readouterr()
    assert "decimated to 20 triangles; --max-triangles keeps more" in told.out and not told.err


def test_a_scan_without_its_unit_is_warned_of(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    monkeypatch.setattr(dm, "tetrahedralize", lambda *given: dm.cube(3))
    with pytest.warns(
        UserWarning, match=r"largest extent is 20 m.* scale=0\.001 \(--scale 0\.001\), or size= \(--size\)"
    ):
        assert run("mesh", scan, "-o", scan.with_name("part.vtu")) == 0


def test_quality_is_shown() -> None:
    text = cli.mesh_report(dm.cube(3), 2 * dm.cube(3).volume.sum(), 1.0)
    assert "27 vertices" in text and "(-50.00% of the surface's)" in text and "0 tets below 0.1" in text


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
