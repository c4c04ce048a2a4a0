"""Claim: `reference.intersections` finds exactly the edges that cross triangles, whatever rounding does."""

from fractions import Fraction

import numpy as np
import pytest
import torch

from diffvbd.reference import intersections

TRIANGLE = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]


def crosses(p: list[float], q: list[float]) -> bool:
    """Whether the edge from p to q crosses TRIANGLE."""
    found = intersections(np.array([*TRIANGLE, p, q]), np.array([[0, 1, 2]]), np.array([[3, 4]]))
    assert found.shape in ((0, 2), (1, 2))
    return len(found) == 1


@pytest.mark.parametrize(
    ("p", "q", "expected"),
    [
        ([0.2, 0.3, -1], [0.2, 0.3, 1], True),
        ([0.2, 0.3, 1], [0.3, 0.2, -1e-300], True),
        ([0.2, 0.3, 1], [0.2, 0.3, 1e-300], False),  # above
        ([0.6, 0.6, -1], [0.6, 0.6, 1], False),  # beside
        ([0.2, 0.3, 0], [0.2, 0.3, 1], False),  # an end touches
        ([0.2, 0.3, 0], [5, 5, 0], False),  # in the plane
        ([0.5, 0.5, -1], [0.5, 0.5, 1], True),  # through an edge
        ([0.0, 0.0, -1], [0, 0, 1], True),  # through a corner
        ([0.5, np.nextafter(0.5, 1), -1], [0.5, np.nextafter(0.5, 1), 1], False),  # an ulp beside
        ([0.2, 0.3, 1], [0.2, 0.3, 1], False),  # without length
    ],
)
def test_one_triangle(p: list[float], q: list[float], expected: bool) -> None:
    assert crosses(p, q) == crosses(q, p) == expected


def test_signs_survive_rounding() -> None:
    """An edge along a ray that grazes the diagonal, moved by single ulps: compared with exact fractions."""
    found, expected = [], []
    for step in range(-8, 9):
        y = 0.3 + step * 2.0**-54
        found.append(crosses([0.7, y, -0.1], [0.7, y, 3.3]))
        expected.append(Fraction(0.7) + Fraction(y) <= 1)
    assert found == expected and any(found) and not all(found)


def brute(x: np.ndarray, triangles: np.ndarray, edges: np.ndarray) -> list[tuple[int, int]]:
    """p + t (q - p) = a + u (b - a) + v (c - a), solved for each pair."""
    found = []
    for e, (i, j) in enumerate(edges):
        for f, corners in enumerate(triangles):
            if {i, j} & set(corners):
                continue
            a, b, c = x[corners]
            t, u, v = np.linalg.solve(np.stack((x[i] - x[j], b - a, c - a), 1), x[i] - a)
            if 0 < t < 1 and u >= 0 and v >= 0 and u + v <= 1:
                found.append((e, f))
    return found


@pytest.mark.parametrize("scale", (1.0, 1e-9, 1e6))
def test_random_soup(rng: np.random.Generator, scale: float) -> None:
    x = scale * rng.standard_normal((60, 3))
    triangles = np.stack([rng.choice(60, 3, replace=False) for _ in range(60)])
    edges = np.stack([rng.choice(60, 2, replace=False) for _ in range(80)])
    expected = brute(x, triangles, edges)
    assert len(expected) > 50
    assert intersections(x, triangles, edges).tolist() == [list(pair) for pair in expected]
    given = (torch.from_numpy(a) for a in (x, triangles, edges))
    assert intersections(*given).tolist() == [list(pair) for pair in expected]
