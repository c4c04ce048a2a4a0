"""Claim: meshes of trimesh, pyvista and meshio are taken as files are, and a boundary is written for other programs."""

from pathlib import Path

import meshio
import numpy as np
import pytest

import diffvbd as dv
from diffvbd import mesh as dm
from diffvbd.mesh.tet_mesh import boundary_faces
from diffvbd.testing import tolerance

BODY = dm.bunny(8)


def test_trimesh() -> None:
    trimesh = pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    surface = trimesh.Trimesh(BODY.points, BODY.surface, process=False)
    assert dm.repair(surface).volume == pytest.approx(BODY.volume.sum())
    assert dm.repair(trimesh.Scene([surface, surface.copy().apply_translation((1, 0, 0))])).pieces == 2
    corners = dv.colliders.Obstacle(surface).corners()
    assert np.array_equal(corners.points, BODY.points) and np.array_equal(corners.triangles, BODY.surface)
    with pytest.raises(ValueError, match="mesh of type Trimesh has no tets .*; .* fill a surface"):
        dm.load(surface)


def test_pyvista() -> None:
    pyvista = pytest.importorskip("pyvista", reason="needs the extra [viz]")
    rows = np.insert(BODY.tets, 0, 4, axis=1)
    grid = pyvista.UnstructuredGrid(rows.ravel(), np.full(BODY.num_tets, 10), BODY.points)
    grid.cell_data["mu"], grid.point_data["u"] = np.arange(BODY.num_tets), BODY.points
    mesh, point_data, cell_data = dm.load_fields(grid)
    assert np.array_equal(mesh.tets, BODY.tets) and np.array_equal(point_data["u"], mesh.points)
    assert np.array_equal(cell_data["mu"], np.arange(BODY.num_tets))
    assert dm.repair(pyvista.Cube()).volume == pytest.approx(1.0)  # of quads
    assert len(dv.colliders.Obstacle(pyvista.Cube()).corners().triangles) == 12


def test_meshio() -> None:
    points, kinds = dm.cube(2).points, ("hexahedron", [[0, 4, 6, 2, 1, 5, 7, 3]])
    with pytest.warns(UserWarning, match="mesh of type Mesh: 1 hexahedron cells are cut into tets"):
        assert dm.load(meshio.Mesh(points, [kinds])).volume.sum() == pytest.approx(1.0)
    with pytest.raises(ValueError, match="has no triangles; it has 794 tets, which dv.mesh.load reads"):
        dm.repair(meshio.Mesh(BODY.points, [("tetra", BODY.tets)]))


@pytest.mark.parametrize("extension", ["stl", "obj", "ply"])
def test_a_boundary_is_written(tmp_path: Path, extension: str) -> None:
    pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    path = tmp_path / f"body.{extension}"
    dm.save(path, BODY, points=2 * BODY.points)
    found = dm.repair(path)
    assert (found.turned, found.dropped, len(found.points)) == (0, 0, len(np.unique(BODY.surface)))
    assert found.volume == pytest.approx(8 * BODY.volume.sum(), rel=tolerance("float32_forward"))
    with pytest.raises(ValueError, match="points: expected shape"):
        dm.save(path, BODY, points=BODY.points[1:])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_interfaces_do_not_change_the_volume(axis: int, rng: np.random.Generator) -> None:
    pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    box = dm.box((5, 5, 3), (1.0, 1.0, 0.1))
    lower = box.points[box.tets].mean(1)[:, axis] < box.points[:, axis].max() / 2
    faces = np.concatenate([boundary_faces(box.tets[part], box.num_vertices)[0] for part in (lower, ~lower)])
    faces = np.unique(np.sort(faces, axis=1), axis=0)
    flipped = rng.random(len(faces)) < 0.5
    faces[flipped] = faces[flipped][:, ::-1]
    found = dm.repair((box.points, faces))
    assert found.volume == pytest.approx(0.1) and found.crowded_edges > 0


def test_a_body_within_a_body_is_no_cavity() -> None:
    pytest.importorskip("trimesh", reason="needs the extra [mesh]")
    outer, inner = dm.cube(3), dm.cube(2, size=0.5).translate((0.25, 0.25, 0.25))
    points = np.concatenate([outer.points, inner.points])
    faces = np.concatenate([outer.surface, inner.surface + outer.num_vertices])
    assert dm.repair((points, faces)).volume == pytest.approx(1.0)
