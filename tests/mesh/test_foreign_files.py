"""Claim: files of other programs arrive whole, or it is said what is not in the mesh; a truncated one never hangs."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from diffvbd import mesh as dm

CASES = Path(__file__).parent / "cases"
MSH = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{}\n{}\n$EndNodes\n$Elements\n{}\n{}\n$EndElements\n"
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
NODES = "\n".join(f"{k + 1} {x} {y} {z}" for k, (x, y, z) in enumerate(CORNERS))
TET = "1 4 2 1 1 1 2 4 5"
V1 = "$NOD\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n$ENDNOD\n$ELM\n1\n1 4 1 1 4 1 2 3 4\n$ENDELM\n"
ROWS = "1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n"


@pytest.mark.parametrize(
    ("name", "bodies", "vertices", "says"),
    [
        ("apart_41", 2, 90, None),
        ("partly_41", 1, 78, "neither its groups"),
        ("parts_41", 1, 78, "neither its groups"),
        ("plain_o1_40", 1, 78, None),
        ("unwelded_41", 2, 90, "12 vertices lie where another one does"),
    ],
)
def test_files_of_gmsh(name: str, bodies: int, vertices: int, says: str | None) -> None:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        mesh = dm.load(CASES / f"{name}.msh")
    assert (mesh.num_bodies, mesh.num_vertices, mesh.num_tets) == (bodies, vertices, 200)
    assert mesh.volume.sum() == pytest.approx(2.0)
    assert [says in str(each.message) for each in found] == ([True] if says else [])
    assert all(each.filename == __file__ for each in found)


def test_weld_joins_what_was_meshed_apart() -> None:
    mesh, vertices = dm.load(CASES / "unwelded_41.msh", weld=1e-6, return_vertices=True)
    assert (mesh.num_bodies, mesh.num_vertices, len(vertices)) == (1, 78, 78)
    with pytest.raises(ValueError, match="weld: expected less than the shortest edge"):
        dm.load(CASES / "unwelded_41.msh", weld=1.0)


@pytest.mark.parametrize(
    ("cell", "volume"),
    [("5 2 1 1 1 2 3 4 5 6 7 8", 1.0), ("6 2 1 1 1 2 4 5 6 8", 0.5), ("7 2 1 1 1 2 3 4 5", 1 / 3)],
)
def test_other_cells_are_cut(tmp_path: Path, cell: str, volume: float) -> None:
    (tmp_path / "a.msh").write_text(MSH.format(8, NODES, 1, f"1 {cell}"))
    with pytest.warns(UserWarning, match="cells are cut into tets"):
        mesh = dm.load(tmp_path / "a.msh", orient=False)
    assert mesh.volume.sum() == pytest.approx(volume)


@pytest.mark.parametrize(
    ("files", "tets"),
    [
        ({"a.msh": V1}, 1),
        ({"a.node": f"5 3 0 0\n{ROWS}5 1 1 1\n", "a.ele": "2 4 1\n1 1 2 3 4 1.5\n2 2 3 4 5 2.5\n"}, 2),
        ({"a.inp": f"*NODE\n{ROWS}*ELEMENT, TYPE=C3D4\n1,1,2,3,4\n*NODE\n5,1,1,1\n".replace(" ", ",")}, 1),
    ],
)
def test_formats_that_meshio_refuses(tmp_path: Path, files: dict[str, str], tets: int) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text.replace("*ELEMENT,,", "*ELEMENT,"))
    assert dm.load(tmp_path / list(files)[-1]).num_tets == tets


PIECE = '<Piece NumberOfPoints="0" NumberOfCells="0"/>'


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.msh", MSH.format(2147483648, NODES, 1, TET), "names 2147483648 nodes and has"),
        ("a.msh", MSH.format(8, NODES.replace("8 0 1 1", "1 0 1 1"), 1, TET), "have the same number"),
        ("a.msh", "(0 nothing)", "Ansys Fluent"),
        ("a.vtu", f"<VTKFile>{PIECE}{PIECE}</VTKFile>", "2 pieces, of which meshio keeps the last"),
        ("a.mesh", "MeshVersionFormatted 2\nDimension 3\nRidges\n2147483648\n", "ends within a block"),
        ("a.bdf", "BEGIN BULK\n", "ends within a block"),
        ("a.inp", "*NODE\n1,0,0,0\n*NODE\n1,1,1,1\n", "use the same numbers"),
        ("a.off", "OFF\n# a comment", "has no tets: .off files hold surfaces"),
    ],
)
def test_refused_by_name_and_at_once(tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=says):
        dm.load(tmp_path / name)


VERTICES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0.5 2 0\nv 0 1 0\n"


@pytest.mark.parametrize("face", ["f 1/1 2/1 3/1 4/1 5/1", "f -5 -4 -3 -2 -1"])
def test_surfaces_with_textures_and_many_corners(tmp_path: Path, face: str) -> None:
    pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    (tmp_path / "a.obj").write_text(f"{VERTICES}vt 0 0\n{face}\n")
    found = dm.repair(tmp_path / "a.obj")
    a, b, c = found.points[found.triangles].transpose(1, 0, 2)
    assert len(found.triangles) == 3
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.ply", "ply\nformat ascii 1.0\n"),
        ("a.off", "OFF\n# a comment"),
        ("a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n"),
    ],
)
def test_truncated_surfaces_are_refused(tmp_path: Path, name: str, text: str) -> None:
    pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match="cannot read"):
        dm.repair(tmp_path / name)
