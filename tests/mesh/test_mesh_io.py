"""Mesh files: round trips, what is dropped on reading, time series, and one clear line for every bad file."""

import importlib.util
import sys
import xml.etree.ElementTree as ElementTree

import meshio
import numpy as np
import pytest
import torch

from diffvbd import mesh as dm
from diffvbd.mesh import TetMesh
from diffvbd.testing import tolerance

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9], [1, 1, 1]])


@pytest.mark.parametrize("extension", ["msh", "vtu", "vtk", "mesh", "inp"])
def test_round_trip(tmp_path, extension):
    mesh = dm.bunny()
    mesh.save(tmp_path / f"bunny.{extension}")
    back = dm.load(str(tmp_path / f"bunny.{extension}"))
    assert np.array_equal(back.points, mesh.points)
    assert np.array_equal(back.tets, mesh.tets)
    assert back.num_bodies == 1


@pytest.mark.parametrize("extension", ["msh", "vtu", "vtk", "mesh"])
def test_round_trip_keeps_bodies(tmp_path, extension, capfd):
    mesh = dm.join([dm.beam(3, 2, 2), dm.cube(), dm.cube(3)])
    path = tmp_path / f"three.{extension}"
    dm.save(path, mesh)
    assert np.array_equal(dm.load(path).body, mesh.body)
    assert capfd.readouterr() == ("", ""), "meshio's chatter got through"


def test_load_merges_blocks_drops_unused_vertices_and_orients(tmp_path):
    cells = [("triangle", [[0, 1, 2]]), ("tetra", [[0, 1, 2, 3]]), ("line", [[3, 4]]), ("tetra", [[1, 2, 3, 5]])]
    meshio.Mesh(POINTS, cells).write(tmp_path / "mixed.vtu")
    mesh, vertices = dm.load(tmp_path / "mixed.vtu", return_vertices=True)
    assert vertices.tolist() == [0, 1, 2, 3, 5]
    assert np.array_equal(mesh.points, POINTS[vertices])
    assert np.array_equal(np.sort(vertices[mesh.tets]), [[0, 1, 2, 3], [1, 2, 3, 5]])
    meshio.Mesh(POINTS, [("tetra", [[0, 1, 2, 3], [1, 3, 2, 5]])]).write(tmp_path / "inverted.vtu")
    assert dm.load(tmp_path / "inverted.vtu").volume.min() > 0
    with pytest.raises(ValueError, match=r"inverted.vtu: tets: expected positive volumes, got inverted 1 tet: 1 of 2"):
        dm.load(tmp_path / "inverted.vtu", orient=False)


def test_load_takes_the_corners_of_second_order_tets(tmp_path):
    middles = [(POINTS[i] + POINTS[j]) / 2 for i, j in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]
    points = np.concatenate([POINTS[:4], middles])
    meshio.Mesh(points, [("tetra10", [list(range(10))])]).write(tmp_path / "quadratic.vtu")
    with pytest.warns(UserWarning, match="1 tetra cells keep their corners alone"):
        assert np.array_equal(dm.load(tmp_path / "quadratic.vtu").points, POINTS[:4])


def test_labels_that_cut_through_a_body_are_not_bodies(tmp_path):
    cells = [("tetra", [[0, 1, 2, 3], [1, 2, 3, 5]])]
    meshio.Mesh(POINTS, cells, cell_data={"body": [np.array([4, 5])]}).write(tmp_path / "glued.vtu")
    assert dm.load(tmp_path / "glued.vtu").body.tolist() == [0] * 5


def test_missing_directory_and_tetless_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere.msh does not exist"):
        dm.load(tmp_path / "nowhere.msh")
    with pytest.raises(FileNotFoundError, match="is not a file"):
        dm.load(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"directory .* does not exist"):
        dm.cube().save(tmp_path / "no" / "cube.vtu")
    meshio.Mesh(POINTS, [("triangle", [[0, 1, 2]])]).write(tmp_path / "flat.vtu")
    with pytest.raises(ValueError, match=r"flat.vtu has no tets \(it has triangle\); .*tetrahedralize"):
        dm.load(tmp_path / "flat.vtu")
    (tmp_path / "part.unknown").write_text("?")
    with pytest.raises(ValueError, match=r"cannot read .*part.unknown"):
        dm.load(tmp_path / "part.unknown")
    with pytest.raises(ValueError, match=r"cannot write .*cube.unknown"):
        dm.cube().save(tmp_path / "cube.unknown")
    with pytest.raises(ValueError, match="hold no tets"):
        dm.cube().save(tmp_path / "cube.off")
    with pytest.raises(ValueError, match="at least one tet to write"):
        TetMesh([], []).save(tmp_path / "empty.vtu")


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: dm.load(None), "source: expected a path, or a mesh of .* got NoneType"),
        (lambda: dm.load_fields(3), "source: expected a path, or a mesh of .* got int"),
        (lambda: dm.save(None, dm.cube()), "path: expected a path, got NoneType"),
        (lambda: dm.save("a.vtu", 3), "mesh: expected a diffvbd.TetMesh, got int"),
        (lambda: dm.write_series(b"a.pvd", dm.cube(), []), "path: expected a path, got bytes"),
        (lambda: dm.write_series("a.pvd", "cube", []), "mesh: expected a diffvbd.TetMesh, got str"),
    ],
)
def test_what_is_no_path_or_no_mesh_is_named(call, says):
    with pytest.raises(TypeError, match=says):
        call()


@pytest.mark.parametrize("extension", ["msh", "vtu", "vtk", "mesh"])
def test_truncated_file_gives_one_line(tmp_path, extension, capfd):
    path = tmp_path / f"cube.{extension}"
    dm.cube(3).save(path)
    whole = path.read_bytes()
    for share in (0.0, 0.02, 0.3, 0.6, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match="cube") as caught:
            dm.load(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_file_with_bad_numbers_names_the_file(tmp_path):
    points = POINTS.copy()
    points[5] = np.nan
    meshio.Mesh(points, [("tetra", [[0, 1, 2, 3], [1, 2, 3, 5]])]).write(tmp_path / "nan.vtu")
    with pytest.raises(ValueError, match=r"nan.vtu: points: expected finite numbers"):
        dm.load(tmp_path / "nan.vtu")
    meshio.Mesh(POINTS, [("tetra", [[0, 1, 2, 17]])]).write(tmp_path / "index.vtu")
    with pytest.raises(ValueError, match=r"index.vtu: expected vertex indices from 0 to 5, got 0..17"):
        dm.load(tmp_path / "index.vtu")


def test_series_lists_frames_that_can_be_read_back(tmp_path):
    mesh = dm.join([dm.cube(), dm.cube()])
    frames = mesh.points + np.linspace(0, 1, 3)[:, None, None]
    speed = np.arange(3 * 16).reshape(3, 16)
    differentiated = torch.from_numpy(frames).requires_grad_()  # as the frames of a rollout are
    dm.write_series(
        tmp_path / "fall & rise.pvd", mesh, differentiated, times=[0, 0.1, 0.2], point_data={"v": frames, "s": speed}
    )
    entries = ElementTree.parse(tmp_path / "fall & rise.pvd").getroot().findall("Collection/DataSet")
    assert [float(entry.attrib["timestep"]) for entry in entries] == [0, 0.1, 0.2]
    for k, entry in enumerate(entries):
        content = meshio.read(tmp_path / entry.attrib["file"])
        assert np.array_equal(content.points, frames[k])
        assert np.array_equal(content.point_data["v"], frames[k])
        assert np.array_equal(content.point_data["s"], speed[k])
        assert np.array_equal(dm.load(tmp_path / entry.attrib["file"]).body, mesh.body)


def test_a_full_disk_is_named_with_the_file_and_leaves_the_one_before(tmp_path, monkeypatch):
    mesh = dm.cube(2)

    def fill(path, *_):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(dm.motions, "write_gltf", fill)
    monkeypatch.setattr(meshio.Mesh, "write", lambda self, path: fill(path))
    for name in ("motion.glb", "motion.pvd"):
        (tmp_path / name).write_bytes(b"before")
        with pytest.raises(OSError, match="No space left on device: .*motion"):
            dm.write_series(tmp_path / name, mesh, mesh.points[None])
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"before", b"before"]


@pytest.mark.parametrize(
    ("name", "arguments", "says"),
    [
        ("a.vtk", {}, "path: expected a name that ends in .pvd"),
        ("a.pvd", {"frames": np.zeros((8, 3))}, r"frames: expected shape \[\*, 8, 3\], got \[8, 3\]"),
        ("a.pvd", {"times": [0.0]}, r"times: expected shape \[2\]"),
        ("a.pvd", {"times": [1.0, 0.0]}, "times: expected times that never decrease"),
        ("a.pvd", {"point_data": {"s": np.zeros(8)}}, r"point_data\['s'\]: expected shape"),
    ],
)
def test_bad_series_writes_nothing(tmp_path, name, arguments, says):
    cube = dm.cube()
    with pytest.raises(ValueError, match=says):
        dm.write_series(tmp_path / name, cube, **{"frames": np.stack([cube.points] * 2), **arguments})
    assert not list(tmp_path.iterdir())


def test_tetrahedralize_without_its_extra_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    cube = dm.cube()
    with pytest.raises(ImportError, match=r"pip install diffvbd\[mesh\]"):
        dm.tetrahedralize((cube.points, cube.surface))


def test_tetrahedralize_warns_of_a_file_that_is_hardly_in_metres(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pytetwild", None)  # warned of before anything takes long
    cube = dm.cube(size=200.0)
    meshio.Mesh(cube.points, [("triangle", cube.surface)]).write(tmp_path / "cube.stl")
    with (
        pytest.warns(UserWarning, match=r"extent is 200 m, .*repair\(surface, scale=0\.001\)"),
        pytest.raises(ImportError),
    ):
        dm.tetrahedralize(tmp_path / "cube.stl")


def test_tetrahedralize_bad_input(tmp_path):
    cube = dm.cube()
    with pytest.raises(FileNotFoundError, match="does not exist"):
        dm.tetrahedralize(tmp_path / "scan.ply")
    with pytest.raises(TypeError, match="surface: expected a path"):
        dm.tetrahedralize(3)
    with pytest.raises(ValueError, match="surface: expected triangles, got none"):
        dm.tetrahedralize((cube.points, cube.surface[:0]))
    with pytest.raises(ValueError, match="triangles: expected vertex indices"):
        dm.tetrahedralize((cube.points, cube.surface + 1))
    with pytest.raises(ValueError, match="edge_length: expected a positive length"):
        dm.tetrahedralize((cube.points, cube.surface), edge_length=0)
    with pytest.raises(ValueError, match="edge_length: expected at most the diagonal of the body, .* m, got 50"):
        dm.tetrahedralize((cube.points, cube.surface), edge_length=50)
    with pytest.raises(TypeError, match=r"surface: .*got TetMesh: give its \.surface"):
        dm.tetrahedralize(cube)
    meshio.Mesh(POINTS, [("line", [[0, 1]])]).write(tmp_path / "lines.vtu")
    with pytest.raises(ValueError, match=r"lines.vtu has no triangles"):
        dm.tetrahedralize(tmp_path / "lines.vtu")


@pytest.mark.skipif(importlib.util.find_spec("pytetwild") is None, reason="needs the extra [mesh]")
def test_tetrahedralize_fills_a_file(tmp_path):
    cube = dm.cube(3, size=0.1)
    meshio.Mesh(cube.points, [("triangle", cube.surface)]).write(tmp_path / "cube.stl")
    mesh = dm.tetrahedralize(tmp_path / "cube.stl", edge_length=0.03)
    assert isinstance(mesh, TetMesh)
    np.testing.assert_allclose(mesh.volume.sum(), 1e-3, rtol=tolerance("meshed_anew"))
    assert len(np.unique(mesh.tets)) == mesh.num_vertices
