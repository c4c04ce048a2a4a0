"""Claim: values of vertices and tets come back from a file as they were written, row by row, and nothing is left out
without a word."""

from pathlib import Path

import meshio
import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd import mesh as dm

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9], [1, 1, 1]])
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
    x, _ = dv.step(
        model, model.rest_points, torch.ones_like(model.rest_points), mu=mu, lam=lam, time_step=0.01, sweeps=4
    )
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
