"""Claim: what a scene does not use costs nothing: a plain step calls two operators of the package, and none of any
feature; `bench absent` counts them."""

import json
from pathlib import Path

import pytest

from bench import absent
from bench.__main__ import main

CALLED = {  # operators that tell of a feature
    "coarse corrections": {"coarse_matrix"},
    "rigid correction": {"rigid"},
    "floor with friction": {"contact_rigid_system"},
    "contact of bodies": {"contact_detect"},
    "self-contact": {"contact_detect"},
    "collider": {"contact_detect"},
    "gradient of the state": {"sweep_backward"},
}


def test_a_plain_step_calls_two_operators_of_the_package() -> None:
    model, once = absent.scene(absent.Feature(), True, "cpu")
    assert absent.counted(once).own() == {"diffvbd::begin": 1, "diffvbd::sweep": 1}
    assert model.surface_of_contact is None and not hasattr(model, "_coarse_plan")
    assert hasattr(absent.scene(absent.FEATURES["coarse corrections"], True, "cpu")[0], "_coarse_plan")


@pytest.mark.parametrize("name", ["SDIRK2", "floor", "anchors", "coarse corrections"])
def test_what_is_there_is_seen(name: str) -> None:
    """A count that saw nothing would find no cost of anything."""
    plain, more = (
        absent.scene(feature, True, "cpu") for feature in (absent.Feature(), absent.FEATURES[name])
    )  # fmt: skip
    operators = absent.counted(more[1]).names.total() > absent.counted(plain[1]).names.total()
    assert operators or absent.model_bytes(more[0]) > absent.model_bytes(plain[0])


def test_quick(tmp_path: Path) -> None:
    assert main(["absent", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "absent.json").read_text())["results"]
    rows = {row["feature"]: row for row in results["rows"]}
    assert results["plain"]["kept"] == 0
    assert list(rows) == list(absent.FEATURES) and set(results["plain"]["own"]) == {"diffvbd::begin", "diffvbd::sweep"}
    for name, operators in CALLED.items():
        assert operators <= {key.split("::")[1] for key in rows[name]["own"]}, name
    assert all((row["kept"] > 0) == name.startswith("gradient") for name, row in rows.items())
