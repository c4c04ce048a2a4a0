"""Claim: the size of the work decides how the sweeps of a step, and their reverse, are spread over a CUDA device."""

import itertools

import pytest

from diffvbd.ops.regimes import BLOCK, COLOR, GRID, MANY_LANES, SOME_LANES, SOME_REVERSE_LANES, THREAD, choose, regime

COLORS = 8


@pytest.mark.parametrize(
    ("vertices", "scenes", "expected"),
    [
        (8, 1, (THREAD, THREAD)),
        (27, 512, (BLOCK, BLOCK)),
        (27, 4096, (THREAD, THREAD)),
        (343, 512, (BLOCK, BLOCK)),
        (343, 64, (GRID, GRID)),
        (9_261, 8, (GRID, COLOR)),
        (9_261, 64, (COLOR, COLOR)),
        (1_331, 4096, (GRID, GRID)),
        (195_112, 1, (COLOR, COLOR)),
    ],
)
def test_sizes_that_were_measured_have_their_regimes(vertices: int, scenes: int, expected: tuple[int, int]) -> None:
    assert choose(vertices, COLORS, scenes)[:2] == expected


def test_a_scene_per_thread_is_of_both_directions_or_of_neither() -> None:
    """Its tape has an order of its own."""
    for vertices, scenes in itertools.product((1, 8, 9, 32, 33, 1_000, 1_001, 10_001), (1, 64, 256, 4096, 1_000_000)):
        for contact, corrects in itertools.product((False, True), repeat=2):
            forward, reverse, *_ = choose(vertices, COLORS, scenes, contact, corrects)
            assert (forward == THREAD) == (reverse == THREAD)


def test_contact_has_one_regime() -> None:
    assert choose(275, COLORS, 1, contact=True) == (GRID, GRID, MANY_LANES, MANY_LANES)
    assert choose(275, COLORS, 1024, contact=True) == (COLOR, COLOR, SOME_LANES, SOME_REVERSE_LANES)


def test_a_forced_regime_is_of_both_directions() -> None:
    with regime("color"):
        assert choose(343, COLORS, 64)[:2] == (COLOR, COLOR)
