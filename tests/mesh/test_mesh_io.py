"""Mesh files: round trips, what is dropped on reading, time series, and one clear line for every bad file."""

import importlib.util
import sys
import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import meshio
import numpy as np
import pytest
import torch

import diffvbd as dv
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


# --- values of vertices and tets --------------------------------------------------------------------------------------


MESH = dm.join([dm.beam(3, 2, 2), dm.cube(3)])
V, T = MESH.num_vertices, MESH.num_tets


@pytest.fixture
def point_data(rng: np.random.Generator) -> dict:
    v = rng.normal(size=(V, 3))
    return {"velocity": v, "pinned": MESH.points[:, 0] == 0, "order": np.arange(V)}


@pytest.fixture
def cell_data(rng: np.random.Generator) -> dict:
    return {"mu": rng.uniform(1e3, 1e6, T), "lam": torch.rand(T), "stress": rng.normal(size=(T, 9))}


@pytest.mark.parametrize("extension", ["msh", "vtk", "vtu"])
def test_values_come_back_to_the_bit(tmp_path: Path, extension: str, point_data: dict, cell_data: dict) -> None:
    path = tmp_path / f"part.{extension}"
    dm.save(path, MESH, point_data, cell_data)
    mesh, points, cells = dm.load_fields(path)
    assert np.array_equal(mesh.tets, MESH.tets) and np.array_equal(mesh.body, MESH.body)
    assert points.keys() == point_data.keys()
    assert {name for name in cells if ":" not in name} == cell_data.keys()  # Gmsh adds labels of its own
    for given, found in ((point_data, points), (cell_data, cells)):
        for name, values in given.items():
            assert np.array_equal(found[name], np.asarray(values)), name
            torch.as_tensor(found[name])  # of the byte order of this machine
    content = meshio.read(path, file_format="gmsh" if extension == "msh" else None)  # as other programs see it
    assert np.array_equal(content.cell_data["mu"][0], cell_data["mu"])


@pytest.mark.parametrize("extension", ["msh", "vtk", "vtu"])
def test_what_was_read_can_be_written(tmp_path: Path, extension: str, point_data: dict, cell_data: dict) -> None:
    dm.save(tmp_path / f"a.{extension}", MESH, point_data, cell_data)
    first = dm.load_fields(tmp_path / f"a.{extension}")
    dm.save(tmp_path / f"b.{extension}", *first)
    second = dm.load_fields(tmp_path / f"b.{extension}")
    for before, after in zip(first[1:], second[1:], strict=True):
        assert before.keys() == after.keys() and all(np.array_equal(before[k], after[k]) for k in before)


def test_values_follow_vertices_that_stay_and_tets_of_all_blocks(tmp_path: Path) -> None:
    cells = [("tetra", [[0, 1, 2, 3]]), ("triangle", [[0, 1, 2]]), ("tetra", [[1, 3, 2, 5]])]
    data = {"mu": [np.array([1.0]), np.array([7.0]), np.array([2.0])]}
    meshio.Mesh(POINTS, cells, point_data={"speed": np.arange(6.0)}, cell_data=data).write(tmp_path / "mixed.vtu")
    found = dm.load_fields(tmp_path / "mixed.vtu")
    assert found.point_data["speed"].tolist() == [0, 1, 2, 3, 5]
    assert found.cell_data["mu"].tolist() == [1, 2]
    assert found.mesh.volume.min() > 0
    with pytest.raises(ValueError, match="inverted 1 tet"):
        dm.load_fields(tmp_path / "mixed.vtu", orient=False)


def test_moduli_of_a_file_drive_a_step(tmp_path: Path) -> None:
    mesh = dm.beam(4, 2, 2)
    soft = mesh.points[mesh.tets].mean(1)[:, 0] < np.median(mesh.points[:, 0])
    dm.save(tmp_path / "part.vtu", mesh, cell_data={"mu": np.where(soft, 1e4, 1e6), "lam": np.full(mesh.num_tets, 1e5)})
    mesh, _, cells = dm.load_fields(tmp_path / "part.vtu")
    model = dv.Model(mesh, pinned=mesh.points[:, 0] == mesh.points[:, 0].min())
    mu, lam = (torch.as_tensor(cells[name]).requires_grad_() for name in ("mu", "lam"))
    x, _ = dv.step(model, model.rest_points, torch.ones_like(model.rest_points), dv.VBD(0.01, 4), mu=mu, lam=lam)
    x.square().sum().backward()
    assert mu.grad is not None and mu.grad.shape == (mesh.num_tets,) and (mu.grad != 0).all()


def test_series_has_values_of_tets(tmp_path: Path) -> None:
    mesh = dm.cube()
    frames = np.stack([mesh.points] * 2)
    stress = np.arange(2.0 * mesh.num_tets).reshape(2, -1)
    dm.write_series(tmp_path / "a.pvd", mesh, frames, cell_data={"von Mises": stress})
    assert np.array_equal(dm.load_fields(tmp_path / "a_0001.vtu").cell_data["von Mises"], stress[1])
    with pytest.raises(ValueError, match=r"cell_data\['s'\]: expected shape \[2, \d+\] or \[2, \d+, 'C'\], got \[8\]"):
        dm.write_series(tmp_path / "b.pvd", mesh, frames, cell_data={"s": np.zeros(8)})
    assert not list(tmp_path.glob("b*"))


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.mesh", {"point_data": {"s": np.zeros(V)}}, "point_data: expected none, because .mesh files hold no values"),
        ("a.inp", {"cell_data": {"s": np.zeros(T)}}, "cell_data: expected none, because .inp files hold no values"),
        (
            "a.vtu",
            {"cell_data": {"mu": np.zeros(V)}},
            rf"cell_data\['mu'\]: expected shape \[{T}\] or \[{T}, 'C'\], got",
        ),
        ("a.vtu", {"cell_data": {"F": np.zeros((T, 3, 3))}}, rf"got \[{T}, 3, 3\]"),
        ("a.vtu", {"point_data": {"s": np.full(V, np.nan)}}, r"point_data\['s'\]: expected finite numbers, got NaN"),
        ("a.vtu", {"cell_data": {"body": np.zeros(T)}}, "cell_data: expected another name than 'body'"),
        ("a.vtu", {"point_data": {" ": np.zeros(V)}}, "point_data: expected printable names of values"),
        (
            "a.vtu",
            {"point_data": {"a\nb": np.zeros(V)}},
            r"point_data: expected printable names of values, got 'a\\nb'",
        ),
        ("a.msh", {"cell_data": {'a"b': np.zeros(T)}}, "cell_data: expected names without quotes in a .msh file"),
        ("a.vtk", {"point_data": {"a b": np.zeros(V)}}, "expected names without spaces in a .vtk file, got 'a b'"),
        ("a.msh", {"point_data": {"uv": np.zeros((V, 2))}}, r"point_data\['uv'\]: expected 1 or 3 or 9 columns, got 2"),
        ("a.vtk", {"point_data": {"uv": np.zeros((V, 2))}}, r"point_data\['uv'\]: expected 1 or 3 or 4 .* got 2"),
    ],
)
def test_values_that_would_be_lost_are_refused(tmp_path: Path, name: str, data: dict, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        dm.save(tmp_path / name, MESH, **data)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a&b", "a<b>", 'a"b', "a'b", "a&amp;b", "Größe"])
def test_names_with_signs_of_xml_come_back(tmp_path: Path, name: str) -> None:
    dm.save(tmp_path / "a.vtu", MESH, {name: np.ones(V)}, {name: np.ones(T)})
    frames = MESH.points[None]
    dm.write_series(tmp_path / "b.pvd", MESH, frames, point_data={name: np.ones((1, V))},
                    cell_data={name: np.ones((1, T))})  # fmt: skip
    for file in ("a.vtu", "b_0000.vtu"):
        found = dm.load_fields(tmp_path / file)
        assert list(found.point_data) == list(found.cell_data) == [name]


# --- files of other programs ------------------------------------------------------------------------------------------


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
