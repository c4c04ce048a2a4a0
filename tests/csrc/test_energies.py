"""Claim: every hand-written adjoint in csrc/core and csrc/energies is the derivative of the block above it.

The headers are compiled into a small module (headers.cpp) where Dual numbers in long double are the oracle; central
differences in long double check the oracle. The adjoint is also run in long double, so that a wrong formula cannot hide
behind rounding, nor rounding pass for a wrong formula.
"""

import hashlib
import importlib.util
import os
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.compiler import cxx
from helpers.paths import CSRC, needs_csrc

from diffvbd import energies, ops
from diffvbd._common.constants import CONTACT, FIRST_VERTEX_BIT
from diffvbd.testing import generator, tolerance

SOURCE = Path(__file__).with_name("headers.cpp")


@pytest.fixture(scope="module")
def headers(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """headers.cpp as a module; built once for each state of the headers."""
    compiler = cxx()
    import pybind11

    sources = [SOURCE, *sorted(CSRC.rglob("*.h"))]
    digest = hashlib.sha256(b"".join(p.read_bytes() for p in sources)).hexdigest()[:16]
    cache = getattr(request.config, "cache", None)  # pytest may run without its cache
    folder = tmp_path_factory.mktemp("headers") if cache is None else cache.mkdir("headers")
    target = folder / digest / f"headers{sysconfig.get_config_var('EXT_SUFFIX')}"
    if not target.exists():
        target.parent.mkdir(exist_ok=True)
        built = target.with_suffix(f".{os.getpid()}")
        include = [CSRC, pybind11.get_include(), sysconfig.get_paths()["include"]]
        flags = ["-std=c++17", "-O1", "-ffp-contract=off", "-fvisibility=hidden", "-shared", "-fPIC", "-w"]
        command = [*compiler, *flags, *(f"-I{i}" for i in include), str(SOURCE), "-o", str(built)]
        result = subprocess.run(command, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        built.rename(target)
    spec = importlib.util.spec_from_file_location("headers", target)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def assert_close(value: Any, expected: Any, groups: list[slice], bar: float) -> None:
    """Each group (a vector, or one scalar) within `bar` of its largest entry, none of them zero."""
    value, expected = np.asarray(value), np.asarray(expected)
    assert np.isfinite(value).all() and np.isfinite(expected).all()
    for group in groups:
        scale = np.abs(expected[group]).max()
        assert scale > 0
        assert np.abs(value[group] - expected[group]).max() <= bar * scale, group


# --- stable Neo-Hookean ----------------------------------------------------------------------------------------------

POSITIONS, MATERIAL, WEIGHTS = slice(0, 12), slice(12, 14), slice(14, 18)
ELASTIC = [POSITIONS, slice(12, 13), slice(13, 14), slice(14, 17), slice(17, 18)]


def elastic_input(rng: np.random.Generator, size: float, strain: float, mu: float, lam: float, move: float) -> list:
    """A tet of edge `size` deformed by `strain`, as headers.cpp reads it."""
    rest = size * (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + rng.uniform(-0.2, 0.2, (4, 3)))
    matrix = np.linalg.inv((rest[1:] - rest[0]).T)
    gradients = np.vstack((-matrix.sum(0), matrix))
    volume = abs(np.linalg.det((rest[1:] - rest[0]).T)) / 6
    # (j, i, k, l) is an even permutation of the tet (0, 1, 2, 3): i = 0 goes with j, k, l = 1, 3, 2
    order = [0, 1, 3, 2]
    weights = volume * gradients[0] @ gradients[[1, 3, 2]].T
    positions = (rest + size * strain * rng.standard_normal((4, 3)))[order]
    vectors = [move * size * rng.standard_normal(3), rng.standard_normal(3) / size]  # d_raw, p
    return [*positions.ravel(), mu, lam, *weights, 1 / (6 * volume), *vectors[0], *vectors[1], rng.uniform(1e-6, 1.0)]


CASES = {  # size [m], strain, mu, lam [Pa], |d_raw| over size
    "rest": (1.0, 0.1, 1e4, 2e4, 0.1),
    "tiny": (1e-6, 0.1, 1e4, 2e4, 1e-3),
    "huge": (1e4, 0.3, 1e4, 2e4, 10.0),
    "inverted": (0.1, 3.0, 3e5, 1e6, 1.0),
    "far updates": (1.0, 1.0, 1e2, 1e2, 1e3),
    "stiff": (0.01, 0.2, 1e12, 1e12, 0.1),
    "soft": (0.01, 0.2, 1e-2, 1e-2, 0.1),
    "nearly incompressible": (1.0, 0.3, 1.0, 1e6, 0.1),
    "no shear": (1.0, 0.3, 0.0, 1e5, 0.1),
    "no lam": (1.0, 0.3, 1e5, 0.0, 0.1),
}


@pytest.mark.parametrize("exact", (True, False))
@pytest.mark.parametrize("case", CASES)
def test_elastic_block_vjp(headers: Any, case: str, exact: bool) -> None:
    rng = generator("elastic", case)
    for _ in range(50):
        values = elastic_input(rng, *CASES[case])
        expected = headers.elastic_dual(values, exact)
        groups = ELASTIC[:3] if case == "no shear" else ELASTIC  # k_ij weighs mu: its adjoint vanishes with it
        groups = [*groups, ELASTIC[4]] if case == "no shear" else groups
        assert_close(headers.elastic_vjp(values, exact, True), expected, groups, tolerance("dual"))
        assert_close(headers.elastic_vjp(values, exact, False), expected, groups, tolerance("dual_rounded"))


@pytest.mark.parametrize("exact", (True, False))
@pytest.mark.parametrize("case", CASES)
def test_elastic_product(headers: Any, case: str, exact: bool) -> None:
    rng = generator("elastic product", case)
    for _ in range(50):
        values = [*elastic_input(rng, *CASES[case])[:18], *rng.standard_normal(12)]
        expected = headers.elastic_product_dual(values)  # both blocks are of one energy
        one = [slice(0, 3)]
        assert_close(headers.elastic_product(values, exact, True), expected, one, tolerance("dual"))
        assert_close(headers.elastic_product(values, exact, False), expected, one, tolerance("dual_rounded"))


@pytest.mark.parametrize("exact", (True, False))
def test_lanes_run_the_scalar_program(headers: Any, exact: bool) -> None:
    rng = generator("lanes")
    values = [elastic_input(rng, *list(CASES.values())[i % len(CASES)]) for i in range(headers.lanes)]
    assert headers.lanes_are_scalars(values, exact)


def test_the_energy_of_a_tet_has_the_gradient_of_the_block(headers: Any) -> None:
    rng = generator("tet energy")
    for _ in range(20):
        points, rest, _ = rest_of(rng)
        moved = points + 0.2 * rng.standard_normal((4, 3))
        gradient = np.asarray(headers.energy_gradient([*moved.ravel(), *rest, 1e4, 2e4])).reshape(4, 3)
        order = [0, 1, 3, 2]  # as in elastic_input
        seen = [*moved[order].ravel(), 1e4, 2e4, rest[0], rest[2], rest[1], rest[6]]
        own = np.asarray(headers.elastic_gradient(seen, True))
        assert np.abs(own - gradient[0]).max() <= tolerance("dual_rounded") * np.abs(gradient).max() != 0
        assert np.abs(gradient.sum(0)).max() <= tolerance("dual_rounded") * np.abs(gradient).max()


@pytest.mark.parametrize("lam", (2e4, 0.0, -3e3))
def test_the_stiffness_at_rest_is_the_second_derivative_of_the_energy(headers: Any, lam: float) -> None:
    rng = generator("tet stiffness")
    points, rest, gradients = rest_of(rng)
    hessian = np.asarray(headers.energy_hessian([*points.ravel(), *rest, 1e4, lam], 1e-4)).reshape(12, 12)
    stiffness = np.asarray(headers.rest_stiffness([*gradients.ravel(), 1e4, lam])).reshape(12, 12) / (6 * rest[6])
    assert np.abs(stiffness - hessian).max() <= tolerance("finite_difference") * np.abs(hessian).max()
    values = np.linalg.eigvalsh(stiffness)
    assert (values > -tolerance("dual_rounded") * values.max()).all() and (values > 0.01 * values.max()).sum() == 6
    # below the least lam of a stable body it stays semidefinite
    least = np.asarray(headers.rest_stiffness([*gradients.ravel(), 1e4, -1e4])).reshape(12, 12)
    assert np.linalg.eigvalsh(least).min() > -tolerance("dual_rounded") * np.abs(least).max()


def rest_of(rng: np.random.Generator) -> tuple[np.ndarray, list[float], np.ndarray]:
    """Corners of a tet, its rest scalars, the gradients of its shape functions."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + rng.uniform(-0.2, 0.2, (4, 3))
    matrix = np.linalg.inv((points[1:] - points[0]).T)
    gradients = np.vstack((-matrix.sum(0), matrix))
    volume = np.linalg.det((points[1:] - points[0]).T) / 6
    weights = [volume * gradients[a] @ gradients[b] for a, b in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))]
    return points, [*weights, 1 / (6 * volume)], gradients


# --- floor barrier ---------------------------------------------------------------------------------------------------

PLANES = {
    "one": [(0.0, 1.0, 0.0, 0.3)],
    "wedge": [(0.0, 1.0, 0.0, 0.3), (-0.6, 0.8, 0.0, -0.2), (0.0, 0.6, 0.8, -0.9)],
    "high": [(0.0, 1.0, 0.0, 1e4)],
}


def floor_input(
    rng: np.random.Generator, planes: str, gap: float, kappa: float, dhat: float, down: float, origin: float = 0.0
) -> list:
    """A vertex `gap` above the first plane moving `down`, as headers.cpp reads it."""
    n, height = np.array(PLANES[planes][0][:3]), PLANES[planes][0][3]
    local = origin * rng.standard_normal(3)
    x = (height + gap) * n + np.cross(n, [1.0, 0.0, 0.3]) - local
    # x_prev above x and closer than dhat: the damping is active
    x_prev = x + 0.3 * min(gap, dhat - gap) * n + gap * np.cross(n, rng.standard_normal(3))
    p, d_raw = rng.standard_normal((2, 3))
    step = -down * n + 0.1 * down * rng.standard_normal(3)
    data = [v for a, b, c, h in PLANES[planes] for v in (a, b, c, h, kappa, dhat, 7.0)]
    return [*x, *x_prev, *local, *p, *d_raw, *step, rng.uniform(1e-3, 0.1), rng.standard_normal(), *data]


FLOORS = {  # planes, gap [m], kappa, dhat [m], fall [m]
    "active": ("one", 0.05, 400.0, 0.1, 0.01),
    "wedge": ("wedge", 0.05, 400.0, 1.5, 1.0),
    "nearly touching": ("one", 1e-7, 1e6, 0.02, 1.0),
    "just inside": ("one", 0.0999999, 400.0, 0.1, 0.3),
    "deep predictor": ("one", 0.01, 1e-3, 0.02, 1e6),
    "high": ("high", 0.05, 1e9, 0.1, 1.0),
    "wide": ("one", 0.5, 1.0, 1e3, 1.0),
    "local origin": ("wedge", 0.05, 400.0, 0.1, 1.0, 10.0),
}


@pytest.mark.parametrize("case", FLOORS)
def test_floor_block_vjp(headers: Any, case: str) -> None:
    rng = generator("floor", case)
    # where the share of damping is near 0 or 1, its derivative is what cancelling leaves, also in dual numbers
    faint = case in ("nearly touching", "just inside")
    bar, rounded = (tolerance("damped_fraction" if faint else name) for name in ("dual", "dual_rounded"))
    for _ in range(50):
        values = floor_input(rng, *FLOORS[case])
        expected = np.asarray(headers.floor_dual(values))
        groups = [slice(0, 3), slice(3, 6)]
        assert_close(np.asarray(headers.floor_vjp(values, True))[:6], expected, groups, bar)
        assert_close(np.asarray(headers.floor_vjp(values, False))[:6], expected, groups, rounded)


@pytest.mark.parametrize("case", ("active", "wedge", "deep predictor", "local origin"))
def test_floor_adjoints_against_differences(headers: Any, case: str) -> None:
    """Independent of Dual: position, previous position and all data (normal, height, kappa, dhat, damping)."""
    if headers.long_double_digits < 64:
        pytest.skip("long double is double here: too few digits for differences")
    rng = generator("differences", case)
    for _ in range(20):
        values = floor_input(rng, *FLOORS[case])
        difference = np.asarray(headers.floor_differences(values, 1e-7))
        result = np.asarray(headers.floor_vjp(values, True))
        scale = np.abs(difference[6:13]).max()
        assert scale > 0 and (result[6:13] != 0).any()
        groups = [slice(0, 3), slice(3, 6)]
        assert_close(result, difference, groups, tolerance("finite_difference"))
        for k in range(6, len(result), 7):
            block = slice(k, k + 7)
            size = np.maximum(np.abs(difference[block]), 1e-6 * scale)
            assert (np.abs(result[block] - difference[block]) <= tolerance("finite_difference") * size).all()
        # kappa, dhat and damping of the plane that the vertex is close to matter by themselves
        assert (result[10:13] != 0).all()


@pytest.mark.parametrize("case", ("wedge", "nearly touching", "just inside", "deep predictor", "high", "local origin"))
def test_filter_vjp(headers: Any, case: str) -> None:
    rng = generator("filter", case)
    for _ in range(50):
        values = floor_input(rng, *FLOORS[case])
        expected = headers.filter_dual(values)
        assert 0 < expected[0] < 1, "the filter must bite"
        groups = [slice(0, 1), slice(1, 4), slice(4, 7)]
        assert_close(headers.filter_vjp(values, True), expected, groups, tolerance("dual"))


def test_filter_at_rest_and_at_the_guard(headers: Any) -> None:
    """No approach: alpha = 1. A gap that rounding could close: alpha = 0. Both are constants."""
    rng = generator("filter", "guard")
    away = floor_input(rng, "one", 0.05, 400.0, 0.1, -0.01)
    assert headers.filter_vjp(away, False) == headers.filter_dual(away) == [1.0] + [0.0] * 6
    closing = floor_input(rng, "high", 0.05, 400.0, 0.1, 1.0)
    closing[1] = 1e4 + 2e-12  # one spacing above the plane
    assert headers.filter_vjp(closing, False) == [0.0] * 7


# --- anchor, safeguards, solve ---------------------------------------------------------------------------------------


def test_anchor_adjoint(headers: Any) -> None:
    """Anchor brings only its block(): Dual must give -h^2 k p and its companions."""
    rng = generator("anchor")
    for _ in range(20):
        values = rng.standard_normal(24)
        values[18] = 0.1
        x, p, d_raw, h2, k, point = values[:3], values[9:12], values[12:15], 0.1**2, values[20], values[21:]
        expected = [*(-h2 * k * p), *np.zeros(3), -h2 * ((x - point) @ p + d_raw @ p), *(h2 * k * p)]
        result = headers.anchor_vjp(list(values))
        assert np.abs(np.array(result) - expected).max() <= tolerance("dual") * np.abs(expected).max()


@pytest.mark.parametrize("length", (1e-12, 1e-6, 0.1, 1.0, 1e3, 1e9))
@pytest.mark.parametrize("c", (1e-6, 0.1, 1e3))
def test_saturate_vjp(headers: Any, length: float, c: float) -> None:
    rng = generator("saturate", length, c)
    for _ in range(20):
        d_raw, d_bar = (list(scale * rng.standard_normal(3)) for scale in (length, 1.0))
        expected = headers.saturate_dual(d_raw, d_bar, c)
        assert_close(headers.saturate_vjp(d_raw, d_bar, c, True), expected, [slice(0, 3)], tolerance("dual"))
        # far beyond c the part along d_raw cancels to c / |d_raw| of the rest, which is still a vector of that size
        assert_close(headers.saturate_vjp(d_raw, d_bar, c, False), expected, [slice(0, 3)], tolerance("dual_rounded"))
        assert 0 < np.linalg.norm(headers.saturate(d_raw, c)) <= c


def test_saturate_at_zero_and_at_overflow(headers: Any) -> None:
    factor = 0.1 / (0.1 + 1e-12)
    at_zero = headers.saturate_vjp([0.0] * 3, [1.0, 2.0, 3.0], 0.1, False)
    assert np.allclose(at_zero, factor * np.arange(1, 4), rtol=tolerance("ulps"))
    for huge in (1e150, 1e200, 1e300):
        step = headers.saturate([huge, -huge, 0.0], 0.1)
        bar = headers.saturate_vjp([huge] * 3, [1.0] * 3, 0.1, False)
        assert np.linalg.norm(step) <= 0.1 * (1 + tolerance("ulps")) and np.linalg.norm(bar) <= tolerance("overflow")


@pytest.mark.parametrize("condition", (1.0, 1e4, 1e8, 1e12))
@pytest.mark.parametrize("scale", (1e-12, 1.0, 1e12))
def test_solve_is_backward_stable(headers: Any, condition: float, scale: float) -> None:
    rng = generator("solve", condition, scale)
    for _ in range(200):
        q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        values = scale * np.array([1.0, condition ** rng.uniform(-1, 0), 1 / condition])[rng.permutation(3)]
        a = (q * values) @ q.T
        a, b = (a + a.T) / 2, rng.standard_normal(3)
        u = np.array(headers.solve(list(a[np.triu_indices(3)]), list(b), 0.1 * values.min()))
        residual = np.abs(a @ u - b).max()
        assert residual <= tolerance("solve_residual") * (np.abs(a).max() * np.abs(u).max() + np.abs(b).max())
        assert np.abs(u).max() > 0


@pytest.mark.parametrize("stiff", (1e13, 1e16, 1e20, 1e30, 1e100))
def test_solve_of_a_rank_one_block(headers: Any, stiff: float) -> None:
    """m I + s q q^T with s past m / eps: rounding leaves nothing of two pivots, of which the mass is a bound."""
    rng = generator("rank", stiff)
    for _ in range(200):
        q, b = rng.standard_normal((2, 3))
        a = np.eye(3) + stiff * np.outer(q, q)
        u = np.array(headers.solve(list(a[np.triu_indices(3)]), list(b), 1.0))
        assert np.isfinite(u).all() and np.linalg.norm(u) <= 10 * np.linalg.norm(b)


# --- the lists in C++ and in Python ----------------------------------------------------------------------------------


def test_python_tape_is_the_compiled_one(headers: Any) -> None:
    for mask in range(masks()):
        filters = any(mask & bit and has_filter for bit, _, _, has_filter in headers.vertex_energies().values())
        assert headers.keeps_positions(mask) == (filters or bool(mask & CONTACT))
        for policy in (ops.NO_TAPE, ops.COMPACT_TAPE, ops.FULL_TAPE):
            assert ops.tape_rows(policy, mask) == headers.tape_rows(policy, headers.kept_scalars(mask))


def masks() -> int:
    """Bits of a mask run below this: the elastic block's, contact, the vertex energies'."""
    return 1 << (FIRST_VERTEX_BIT + len(energies.VERTEX_ENERGIES))


# --- scalars ----------------------------------------------------------------------------------------------------------


@needs_csrc
def test_one_formula_of_every_scalar(tmp_path: Path) -> None:
    program, source = tmp_path / "scalars", Path(__file__).with_name("scalars.cpp")
    subprocess.run([*cxx(), "-std=c++17", "-w", f"-I{CSRC}", str(source), "-o", str(program)], check=True)
    found = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    assert found.split("\n")[:2] == ["10 10 10 10 7", "8 8 8 8 1"]


# --- distances --------------------------------------------------------------------------------------------------------


@needs_csrc
def test_the_derivative_of_the_closest_feature(tmp_path: Path) -> None:
    program = tmp_path / "distance"
    source = Path(__file__).with_name("distance.cpp")
    flags = ["-std=c++17", "-O1", "-ffp-contract=off", "-w", f"-I{CSRC}"]
    subprocess.run([*cxx(), *flags, str(source), "-o", str(program)], check=True)
    *features, different, moving = map(
        int, subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    )
    point_triangle, edge_edge, plane = features[:5], features[5:10], features[10:]
    # inside a face, and the three edges around it; inside both edges, and the four ends; a plane has no end
    assert min(point_triangle[:4]) > 500 and point_triangle[4] == 0 and min(edge_edge) > 500
    assert plane == [20000, 0, 0, 0, 0]
    assert different == 0 and moving > 40000
