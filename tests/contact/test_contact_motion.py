"""Claim: motion in contact is that of converged steps, at few sweeps: sliding, spinning, falling, resting, standing.

The scenes are those of `python -m bench contact_motion`, which says where their references come from.
"""

from __future__ import annotations

import pytest

from bench import contact_motion_piles as piles
from bench import contact_motion_scenes as scenes
from diffvbd.testing import tolerance


@pytest.mark.parametrize("surface", ["Plane", "FloorBarrier"])
def test_a_block_at_ten_meters_a_second_stops_where_coulombs_law_says(surface: str) -> None:
    row = scenes.slide(surface=surface, sweeps=5)
    assert row["value"] == pytest.approx(row["reference"], rel=tolerance("contact_motion"))


def test_the_derivative_of_a_travel_survives_sliding() -> None:
    gradient, newton = scenes.slide_gradient(surface="Plane", speed=3.0)
    assert gradient["value"] == pytest.approx(gradient["reference"], rel=tolerance("contact_motion"))
    assert newton["met"]


def test_a_body_spins_next_to_another_as_alone() -> None:
    row = scenes.spin()
    assert row["value"] == pytest.approx(row["reference"], rel=tolerance("contact_motion"))


def test_a_frictionless_block_rests() -> None:
    row = piles.rest("Plane", sweeps=5)
    assert abs(row["value"]) <= tolerance("rest_speed")


def test_five_boxes_stand_at_five_sweeps() -> None:
    row = piles.stack(5, sweeps=5, seconds=0.5)
    assert row["met"]


@pytest.mark.slow
def test_a_pinned_sheet_swings_as_without_contact() -> None:
    row = scenes.sheet(sweeps=10)
    assert row["value"] == pytest.approx(row["reference"], rel=tolerance("contact_motion"))
