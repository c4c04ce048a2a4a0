"""Meshes: what TetMesh accepts and refuses, and that every procedural shape is a valid closed body."""

import copy
import pickle

import numpy as np
import pytest

from diffvbd import mesh as dm
from diffvbd.mesh import TetMesh
from diffvbd.testing import tolerance

UNIT_POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
UNIT_TET = np.array([[0, 1, 2, 3]])

SHAPES = {
    "cube": (dm.cube, 8, 5),
    "cube of Kuhn": (lambda: dm.cube(3, split="kuhn"), 27, 48),
    "box": (lambda: dm.box((3, 4, 5), (1, 2, 3)), 60, 120),
    "beam": (lambda: dm.beam(21, 7, 7, size=(0.5, 0.2, 0.2)), 1029, 3600),
    "sheet": (lambda: dm.sheet(22, 11), 484, 1260),
    "flag": (lambda: dm.sheet(17, 13), 442, 1152),
    "disk": (dm.disk, 254, 648),
    "disk of one ring": (lambda: dm.disk(resolution=1), 14, 18),
    "capsule": (dm.capsule, None, None),
    "ball": (lambda: dm.capsule(length=0.0), None, None),
    "blob": (dm.blob, None, None),
    "bunny": (dm.bunny, 341, 1155),
    "dress": (dm.dress, 600, 1680),
    "fine dress": (lambda: dm.dress(22, 21), 924, 2640),
    "subdivided bunny": (lambda: dm.subdivide(dm.bunny()), None, 8 * 1155),
    "two bodies": (lambda: dm.join([dm.cube(), dm.capsule()]), None, None),
}


def unit_ball(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points, axis=1) - 1


THIN = {"sheet", "flag", "disk of one ring", "dress", "fine dress"}


def enclosed_volume(mesh: TetMesh) -> float:
    """Volume inside the surface, by the divergence theorem: negative if the surface is wound inwards."""
    a, b, c = (mesh.points[mesh.surface[:, k]] for k in range(3))
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


def surface_edge_counts(mesh: TetMesh) -> np.ndarray:
    edges = np.sort(mesh.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def num_components(mesh: TetMesh) -> int:
    graph = pytest.importorskip("scipy.sparse")
    csgraph = pytest.importorskip("scipy.sparse.csgraph")
    i, j = mesh.tets[:, [0, 0, 0]].ravel(), mesh.tets[:, 1:].ravel()
    links = graph.coo_array((np.ones(len(i)), (i, j)), shape=(mesh.num_vertices,) * 2)
    return csgraph.connected_components(links, directed=False)[0]


def smallest_dihedral(mesh: TetMesh) -> float:
    """Smallest angle between two faces of a tet [degrees]."""
    corners = mesh.points[mesh.tets]
    outward = []
    for i, j, k in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)):
        normal = np.cross(corners[:, j] - corners[:, i], corners[:, k] - corners[:, i])
        outward.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    cosines = [-(outward[i] * outward[j]).sum(axis=1) for i in range(4) for j in range(i)]
    return float(np.degrees(np.arccos(np.max(cosines))))


@pytest.mark.parametrize("name", SHAPES)
def test_shape_is_a_valid_closed_body(name):
    build, vertices, tets = SHAPES[name]
    mesh = build()
    assert vertices in (None, mesh.num_vertices)
    assert tets in (None, mesh.num_tets)
    assert mesh.volume.min() > 0
    assert mesh.quality.min() > (0.15 if name in THIN else 0.3)
    assert mesh.quality.max() <= 1 + tolerance("geometry")
    assert len(np.unique(mesh.tets)) == mesh.num_vertices, "isolated vertices"
    assert (surface_edge_counts(mesh) == 2).all(), "open or non-manifold surface"
    np.testing.assert_allclose(enclosed_volume(mesh), mesh.volume.sum(), rtol=tolerance("geometry"))
    assert num_components(mesh) == mesh.num_bodies


def test_box_fills_its_size_and_numbers_vertices_as_documented():
    for split in ("kuhn", "five"):
        mesh = dm.box((3, 4, 5), (1, 2, 3), split=split)
        np.testing.assert_allclose(mesh.volume.sum(), 6)
        np.testing.assert_allclose(mesh.points[(1 * 4 + 2) * 5 + 3], [0.5, 4 / 3, 9 / 4])
    assert np.ptp(dm.cube(4, size=2.0, split="kuhn").volume) < tolerance("ulps")


def test_sheet_lies_in_the_xz_plane_lower_layer_first():
    mesh = dm.sheet(5, 4, size=(0.8, 0.3), thickness=0.02)
    assert (mesh.points[:20, 1] == -0.01).all() and (mesh.points[20:, 1] == 0.01).all()
    np.testing.assert_allclose(mesh.points[1 * 4 + 2], [0.2, -0.01, 0.2])
    np.testing.assert_allclose(mesh.volume.sum(), 0.8 * 0.3 * 0.02)


def test_boundary_of_a_filled_body_lies_on_the_surface():
    mesh = dm.capsule(0.1, 0.3)
    on_surface = mesh.points[np.unique(mesh.surface)]
    on_surface[:, 1] -= np.clip(on_surface[:, 1], -0.15, 0.15)
    np.testing.assert_allclose(np.linalg.norm(on_surface, axis=1), 0.1, atol=tolerance("geometry"))


@pytest.mark.parametrize("seed", range(10))
def test_filled_bodies_keep_their_quality_bound(seed):
    random = np.random.default_rng(seed)
    centre, radii = random.uniform(-0.3, 0.3, 3), random.uniform(0.6, 1.0, 3)
    spacing = random.uniform(0.15, 0.45)
    ellipsoid = dm.fill(
        lambda p: np.linalg.norm((p - centre) / radii, axis=1) - 1, centre - radii, centre + radii, spacing
    )
    for mesh in (ellipsoid, dm.blob(seed=seed), dm.bunny(resolution=8 + seed)):
        assert mesh.quality.min() > 0.3
        assert smallest_dihedral(mesh) > 10
        assert (surface_edge_counts(mesh) == 2).all()
        np.testing.assert_allclose(enclosed_volume(mesh), mesh.volume.sum(), rtol=tolerance("geometry"))


def test_dress_hangs_from_neck_to_hem_and_scales_its_radii():
    mesh, small = dm.dress(), dm.dress(scale=0.5)
    ends = [mesh.points[:, 1].max(), mesh.points[:, 1].min()]
    np.testing.assert_allclose(ends, [1.45, 0.65], atol=tolerance("thickness"))
    radius = [np.hypot(m.points[:, 0], m.points[:, 2]).max() for m in (mesh, small)]
    np.testing.assert_allclose(radius, [0.36, 0.18], atol=tolerance("thickness"))


def test_shell_that_is_too_thick_is_refused():
    with pytest.raises(ValueError, match="inverted"):
        dm.dress(thickness=0.5)


@pytest.mark.parametrize("build", [dm.cube, lambda: dm.cube(3, split="five"), dm.blob, dm.dress])
def test_subdivide_is_conforming_and_keeps_the_volume(build):
    coarse = build()
    fine = dm.subdivide(coarse)
    assert fine.num_tets == 8 * coarse.num_tets
    assert np.array_equal(fine.points[: coarse.num_vertices], coarse.points)
    eighths = np.repeat(coarse.volume[:, None], 8, axis=1) / 8
    np.testing.assert_allclose(fine.volume.reshape(-1, 8), eighths, rtol=tolerance("thin_volumes"))
    # Euler: edges become vertices; a face that did not match would appear on the surface.
    edges = np.unique(np.sort(coarse.tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)), axis=0)
    assert fine.num_vertices == coarse.num_vertices + len(edges)
    assert len(fine.surface) == 4 * len(coarse.surface)
    assert (surface_edge_counts(fine) == 2).all()


def test_subdivide_levels_and_labels():
    two = dm.join([dm.cube(split="kuhn"), dm.cube(split="kuhn")])
    assert dm.subdivide(two, levels=0) is two
    fine = dm.subdivide(two, levels=2)
    assert fine.num_tets == 64 * 12 and fine.num_bodies == 2
    assert dm.subdivide(TetMesh([], [])).num_tets == 0
    # The quality of repeated refinement does not decline without end.
    assert dm.subdivide(dm.cube(split="kuhn"), 3).quality.min() > 0.7
    with pytest.raises(ValueError, match="levels"):
        dm.subdivide(two, levels=-1)


def test_replicate_equals_join_of_moved_copies():
    source = dm.join([dm.cube(), dm.cube().translate((2, 0, 0))])
    offsets = np.array([[0.0, 0, 0], [0, 5, 0], [0, 0, -7]])
    fast, slow = dm.replicate(source, offsets), dm.join([source.translate(o) for o in offsets])
    for name in ("points", "tets", "body", "surface"):
        assert np.array_equal(getattr(fast, name), getattr(slow, name)), name
    assert dm.replicate(source, np.empty((0, 3))).num_tets == 0


def test_surface_agrees_with_counting_faces_whatever_the_vertex_numbers():
    coarse = dm.subdivide(dm.bunny())
    surface = {tuple(sorted(face)) for face in coarse.surface.tolist()}
    seen: dict[tuple[int, ...], int] = {}
    for tet in coarse.tets.tolist():
        for k in range(4):
            face = tuple(sorted(tet[:k] + tet[k + 1 :]))
            seen[face] = seen.get(face, 0) + 1
    assert surface == {face for face, times in seen.items() if times == 1}
    # More than 2^21 vertices: three indices no longer fit one 64-bit key.
    offset = 3_000_000
    points = np.zeros((offset + coarse.num_vertices, 3))
    points[offset:] = coarse.points
    far = TetMesh(points, coarse.tets + offset)
    assert np.array_equal(far.surface - offset, coarse.surface)
    order = np.random.default_rng(0).permutation(len(points))
    shuffled = TetMesh(points[np.argsort(order)], order[coarse.tets + offset])
    assert np.array_equal(np.sort(shuffled.surface, axis=0), np.sort(order[coarse.surface + offset], axis=0))


def test_mesh_is_immutable_and_leaves_its_input_alone():
    points, tets = UNIT_POINTS.copy(), UNIT_TET.copy()
    mesh = TetMesh(points, tets)
    points[0], tets[0] = 9.0, 0
    assert mesh.points[0, 0] == 0 and mesh.tets[0, 3] == 3
    for twin in (mesh, pickle.loads(pickle.dumps(mesh)), copy.deepcopy(mesh)):
        for name in ("points", "tets", "body", "volume", "surface"):
            assert np.array_equal(getattr(twin, name), getattr(mesh, name))
            with pytest.raises(ValueError, match="read-only"):
                getattr(twin, name)[0] = 0
            with pytest.raises(AttributeError):
                setattr(twin, name, None)


def test_repr_and_empty_mesh():
    assert repr(dm.cube()) == "TetMesh(8 vertices, 5 tets, bodies: 1, extent 1 x 1 x 1 m)"
    for empty in (TetMesh([], []), TetMesh(np.empty((0, 3)), np.empty((0, 4), dtype=int))):
        assert (empty.num_vertices, empty.num_tets, empty.num_bodies) == (0, 0, 0)
        assert empty.surface.shape == (0, 3) and empty.volume.shape == (0,)
        assert "0 vertices" in repr(empty)
    lonely = TetMesh(UNIT_POINTS, [])
    assert lonely.num_vertices == 4 and lonely.surface.shape == (0, 3)


def test_translate_and_transform():
    mesh = dm.cube().translate((1, 2, 3)).transform(np.diag([2.0, 1, 1]))
    assert mesh.points.min(axis=0).tolist() == [2, 2, 3]
    np.testing.assert_allclose(mesh.volume.sum(), 2)
    with pytest.raises(ValueError, match="determinant"):
        mesh.transform(np.diag([-1.0, 1, 1]))


def test_orient_flips_inverted_tets():
    with pytest.raises(ValueError, match=r"inverted 1 tet: 0 of 1"):
        TetMesh(UNIT_POINTS, [[0, 2, 1, 3]])
    assert TetMesh(UNIT_POINTS, [[0, 2, 1, 3]], orient=True).volume[0] > 0
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    for orient in (False, True):
        with pytest.raises(ValueError, match="zero volume in 1 tet: 0"):
            TetMesh(flat, UNIT_TET, orient=orient)


def test_flatness_is_relative_to_size_so_slivers_and_small_meshes_pass():
    sliver = UNIT_POINTS * [1, 1, 1e-12]
    assert TetMesh(sliver, UNIT_TET).volume[0] > 0
    assert TetMesh(UNIT_POINTS * 1e-9, UNIT_TET).num_tets == 1
    assert TetMesh(UNIT_POINTS * 1e9, UNIT_TET).num_tets == 1
    with pytest.raises(ValueError, match="zero volume"):
        TetMesh([[0, 0, 0], [1, 0.3, 0.1], [0.2, 1, 0.7], [1.2, 1.3, 0.8 + 1e-16]], UNIT_TET)


@pytest.mark.parametrize(
    ("points", "tets", "body", "error", "says"),
    [
        (UNIT_POINTS[:, :2], UNIT_TET, None, ValueError, r"points: expected shape \[\*, 3\], got \[4, 2\]"),
        (UNIT_POINTS + 1j, UNIT_TET, None, TypeError, "points: expected real numbers, got dtype complex128"),
        (np.full((4, 3), "a"), UNIT_TET, None, TypeError, "points: expected real numbers"),
        (UNIT_POINTS * [[1], [1], [1], [np.nan]], UNIT_TET, None, ValueError, "points: .*NaN or Inf in 1 row: 3"),
        (np.full((4, 3), np.inf), UNIT_TET, None, ValueError, "points: .*4 rows: 0, 1, 2, 3"),
        ([[0, 0, 0], [1, 0]], UNIT_TET, None, ValueError, "points: expected an array, or lists of equal lengths"),
        (UNIT_POINTS, [[0, 1, 2, 3], [1]], None, ValueError, "tets: expected an array, or lists of equal lengths"),
        (UNIT_POINTS, UNIT_TET[:, :3], None, ValueError, r"tets: expected shape \[\*, 4\], got \[1, 3\]"),
        (UNIT_POINTS, UNIT_TET * 1.0, None, TypeError, "tets: expected integers, got dtype float64"),
        (UNIT_POINTS, [[0, 1, 2, 4]], None, ValueError, r"tets: .* from 0 to 3, got \[0, 1, 2, 4\] .*1 tet: 0"),
        (UNIT_POINTS, [[0, 1, 2, -1]], None, ValueError, "tets: expected vertex indices from 0 to 3"),
        (UNIT_POINTS, [[0, 1, 2, 2]], None, ValueError, "tets: expected four different vertices.*1 tet: 0"),
        (UNIT_POINTS, [[0, 1, 2, 3], [1, 2, 0, 3]], None, ValueError, r"each tet once, .*\[1, 2, 0, 3\] .*1 tet: 1"),
        (UNIT_POINTS, UNIT_TET, [0, 0, 0], ValueError, r"body: expected shape \[4\], got \[3\]"),
        (UNIT_POINTS, UNIT_TET, [0.0] * 4, TypeError, "body: expected integers"),
        (UNIT_POINTS, UNIT_TET, [0, 0, 0, 1], ValueError, "body: expected one label per tet"),
    ],
)
def test_bad_meshes_are_named(points, tets, body, error, says):
    with pytest.raises(error, match=says):
        TetMesh(points, tets, body)


@pytest.mark.parametrize(
    ("call", "error", "says"),
    [
        (lambda: dm.beam(1, 3, 3), ValueError, "nx: expected at least 2 vertices, got 1"),
        (lambda: dm.cube(2.0), TypeError, "n: expected an integer, got 2.0"),
        (lambda: dm.cube(size=-1), ValueError, "size: expected a positive length, got -1"),
        (lambda: dm.box((2, 2)), ValueError, "n: expected one number or three, got 2"),
        (lambda: dm.box(2, (1, 0, 1)), ValueError, "size: expected positive lengths"),
        (lambda: dm.cube(split="six"), ValueError, 'split: expected "kuhn" or "five", got \'six\''),
        (lambda: dm.sheet(thickness=0), ValueError, "thickness: expected a positive length"),
        (lambda: dm.disk(resolution=0), ValueError, "resolution: expected at least 1"),
        (lambda: dm.capsule(length=-1), ValueError, "length: expected 0 or more"),
        (lambda: dm.capsule(radius=np.nan), ValueError, "radius: expected a finite number"),
        (lambda: dm.dress(neck_height=0.5), ValueError, "hem_height: expected less than neck_height = 0.5"),
        (lambda: dm.shell(UNIT_POINTS, [[0, 1, 9]], 0.1), ValueError, "triangles: expected vertex indices from 0 to 3"),
        (lambda: dm.shell(UNIT_POINTS, [[0, 1, 2]], 0.1), ValueError, "triangles: expected a normal at every vertex"),
        (lambda: dm.replicate(dm.cube(), [0, 0, 0]), ValueError, "offsets: expected shape"),
        (lambda: dm.replicate(3, [[0, 0, 0]]), TypeError, "mesh: expected a diffvbd.TetMesh, got int"),
        (lambda: dm.subdivide(UNIT_POINTS), TypeError, "mesh: expected a diffvbd.TetMesh, got ndarray"),
        (lambda: dm.join(dm.cube()), TypeError, "meshes: expected TetMesh objects, as in a list, got TetMesh"),
        (lambda: dm.TetMesh(UNIT_POINTS, [[0, 1, 2, 3]], orient=np.ones(3)), TypeError, "orient: expected a bool, got"),
        (lambda: dm.load("", orient=np.ones(3)), TypeError, "orient: expected a bool, got ndarray"),
        (lambda: dm.load("", return_vertices="no"), TypeError, "return_vertices: expected a bool, got str"),
        (lambda: dm.join([3]), TypeError, "meshes: expected TetMesh objects, got int at 0"),
        (lambda: dm.fill(lambda p: p[:, 0], (-1,) * 3, (1,) * 3, 0.5), ValueError, "expected a box around the body"),
        (lambda: dm.fill(lambda p: p[:, 0] + 9, (-1,) * 3, (1,) * 3, 0.5), ValueError, "found no point of it"),
        (lambda: dm.fill(lambda p: p, (-1,) * 3, (1,) * 3, 0.5), ValueError, "function: expected shape"),
        (lambda: dm.fill(3, (-1,) * 3, (1,) * 3, 0.5), TypeError, r"function: expected a function of .* got int"),
        (
            lambda: dm.fill(unit_ball, (-1.1,) * 3, (1.1,) * 3, 3.0),
            ValueError,
            "spacing: the body is thinner .* spacing 3;",
        ),
        (lambda: dm.fill(unit_ball, (-1.1,) * 3, (1.1,) * 3, 1e9), ValueError, "spacing: the body is thinner"),
        *(
            (
                lambda h=h: dm.fill(unit_ball, (-1.1,) * 3, (1.1,) * 3, h),
                ValueError,
                "spacing: expected one with at most 1e\\+09 cells",
            )
            for h in (1e-4, 1e-320)
        ),
        (lambda: dm.fill(lambda p: p[:, 0], (1,) * 3, (1,) * 3, 0.5), ValueError, "high: expected more than low"),
    ],
)
def test_bad_shape_arguments_are_named(call, error, says):
    with pytest.raises(error, match=says):
        call()
