"""Claim: `python -m bench integrators` shows order, and impacts that gain nothing."""

from bench import integrators
from diffvbd.testing import tolerance


def test_a_quick_run() -> None:
    results = integrators.run(quick=True)
    (row,) = results["beam"]
    for name in ("SDIRK2", "BDF2"):
        assert 0 < row[f"{name}, error"] < 0.3 * row["implicit Euler, error"]
    assert {row["integrator"] for row in results["impacts"]} == set(integrators.INTEGRATORS)
    for row in results["impacts"]:
        assert row["most gained"] <= tolerance("energy_gain") and 0 < row["left"] < 1 and row["lowest gap [m]"] > 0
    text = integrators.markdown(results)
    assert text.count("## ") == 3 and "| SDIRK2 |" in text
