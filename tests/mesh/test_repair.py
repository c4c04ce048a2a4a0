"""Claim: what scanners leave becomes a surface that encloses the body, upright and in metres, and it is said how."""

import sys
import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest

from diffvbd import mesh as dm
from diffvbd.testing import tolerance


@pytest.fixture(autouse=True)
def needs_trimesh(request: pytest.FixtureRequest) -> None:
    if request.node.name != "test_without_its_extra":
        pytest.importorskip("trimesh", reason="needs the extra [mesh]")


def volume(points: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)


def soup(mesh: dm.TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that share no vertex, as in a .stl file."""
    points = mesh.points[mesh.surface].reshape(-1, 3)
    return points, np.arange(len(points)).reshape(-1, 3)


def test_a_scan_with_every_fault(tmp_path: Path, rng: np.random.Generator) -> None:
    body = dm.bunny(8)
    points, triangles = soup(body)
    flipped = rng.random(len(triangles)) < 0.3
    triangles[flipped] = triangles[flipped][:, ::-1]
    flat = np.stack([triangles[:2, 0], triangles[:2, 1], triangles[:2, 0]], 1)
    faulty = np.concatenate([triangles, triangles[:5], flat])
    points = 1e3 * np.stack([points[:, 0], -points[:, 2], points[:, 1]], 1)  # in mm, z up
    meshio.Mesh(points, [("triangle", faulty)]).write(tmp_path / "scan.vtu")
    found = dm.repair(tmp_path / "scan.vtu", scale=0.001, up="z")
    assert found.welded == len(points) - len(np.unique(body.surface))
    assert found.dropped == 7 and found.turned == flipped.sum()
    assert (found.open_edges, found.crowded_edges, found.pieces) == (0, 0, 1)
    for got in (volume(*found.surface), found.volume):
        np.testing.assert_allclose(got, body.volume.sum(), rtol=tolerance("closed_form"))
    corners = found.points[found.triangles].mean(1)
    wanted = body.points[body.surface].mean(1)
    order, back = (np.lexsort(np.round(c, 6).T) for c in (corners, wanted))
    np.testing.assert_allclose(corners[order], wanted[back], rtol=0, atol=tolerance("closed_form"))
    assert "7 triangles dropped" in str(found) and "closed" in str(found) and "0.001 m per unit" in str(found)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_up_becomes_y_by_a_rotation(up: str) -> None:
    body = dm.box(2, (0.1, 0.2, 0.3))
    direction = np.zeros(3)
    direction["xyz".index(up[-1])] = -1 if up[0] == "-" else 1
    found = dm.repair((body.points, body.surface), up=up)
    assert found.volume > 0
    high = body.points @ direction
    assert found.points[:, 1].max() == pytest.approx(high.max()) and found.points[:, 1].min() == pytest.approx(
        high.min()
    )


def test_size_is_the_largest_extent() -> None:
    body = dm.box(2, (1.0, 2.0, 4.0))
    found = dm.repair((body.points, body.surface), size=0.2)
    assert np.ptp(found.points, axis=0) == pytest.approx([0.05, 0.1, 0.2]) and found.scale == pytest.approx(0.05)


@pytest.mark.parametrize(("given", "warns"), [({}, True), ({"scale": 0.001}, False), ({"size": 200.0}, False)])
def test_a_surface_in_mm_is_warned_of_unless_its_unit_is_given(given: dict[str, float], warns: bool) -> None:
    body = dm.box(2, (80.0, 120.0, 200.0))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        dm.repair((body.points, body.surface), **given)
        dm.repair((1e-3 * body.points, body.surface))
    assert len(found) == warns
    for warning in found:
        assert "200 m" in str(warning.message) and "give scale=0.001 (--scale 0.001), or size=" in str(warning.message)
        assert warning.filename == __file__


@pytest.mark.parametrize("inverted", [False, True])
def test_cavities_stay_and_pieces_apart_are_turned_by_themselves(inverted: bool) -> None:
    outer, inner, apart = dm.cube(3, size=1.0), dm.cube(2, size=0.5), dm.cube(2, size=1.0)
    inner = inner.translate(outer.points.mean(0) - inner.points.mean(0))
    apart = apart.translate((3.0, 0.0, 0.0))
    points = np.concatenate([outer.points, inner.points, apart.points])
    first = len(outer.points)
    hollow = np.concatenate([outer.surface, inner.surface[:, ::-1] + first])
    wrong = apart.surface[:, ::-1] + first + len(inner.points)
    found = dm.repair((points, np.concatenate([hollow[:, ::-1] if inverted else hollow, wrong])))
    assert found.pieces == 3 and found.turned == len(wrong) + (len(hollow) if inverted else 0)
    assert found.volume == pytest.approx(2.0 - 0.125)


def test_holes_and_crowded_edges_are_counted() -> None:
    cube = dm.cube(3)
    found = dm.repair((cube.points, cube.surface[1:, ::-1]))
    assert found.open_edges == 3 and "3 open edges" in str(found) and found.volume > 0
    fins = np.concatenate([cube.points, [[2.0, 2.0, 2.0]]])
    a, b, _ = cube.surface[0]
    found = dm.repair((fins, np.concatenate([cube.surface, [[a, b, len(cube.points)]]])))
    assert found.crowded_edges == 1 and found.open_edges == 2


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"up": "w"}, "up: expected one of y, -y, z, -z, x, -x, got 'w'"),
        ({"up": []}, r"up: expected one of y, -y, z, -z, x, -x, got \[\]"),
        ({"size": 1.0, "scale": 2.0}, "size: expected none with scale = 2.0, got 1.0"),
        ({"size": 0.0}, "size: expected a positive length, got 0"),
        ({"scale": -1.0}, "scale: expected a positive length, got -1"),
        ({"surface": (dm.cube().points, dm.cube().surface[:0])}, "surface: expected triangles, got none"),
        ({"surface": (np.eye(3), [[0, 1, 1]])}, "surface: expected triangles with an area, got none"),
        ({"surface": (np.ones((3, 3)), [[0, 1, 2]])}, "surface: expected an extended body, got a single point"),
    ],
)
def test_bad_input(arguments: dict, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        dm.repair(**{"surface": (dm.cube().points, dm.cube().surface), **arguments})


def test_without_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"repair needs trimesh and networkx: pip install 'diffvbd\[mesh\]'"):
        dm.repair((dm.cube().points, dm.cube().surface))
