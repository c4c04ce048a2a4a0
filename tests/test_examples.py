"""Claim: each program in examples/ runs without a warning and prints the right numbers, among them gradients."""

import re
import runpy
import unittest.mock
import warnings

import pytest
from helpers.marks import quick_and_slow
from helpers.paths import ROOT

FOLDER = ROOT / "examples"
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[+-]\d+)?")
# Lower and upper bound of each printed number, in order.
EXPECTED = {
    "first_gradient": [(0.048, 0.051), (3.5e-7, 4.5e-7)],
    "identify_material": [(79_900, 80_100), (0.399, 0.401), (80_000, 80_000), (0.4, 0.4)],
    "stiffness_field": [(0.43, 0.44), (0.39, 0.41), (399, 401), (99, 101), (199, 201), (99, 101)],
    "contact_drop": [(0.100, 0.120), (0.1087, 0.1088), (0.25, 0.29), (0.27, 0.28), (-0.40, -0.32), (-0.363, -0.362)],
    "soft_gripper": [(7.0, 10.0), (2.0, 6.0), (1.0, 2.5)],
    "train_policy": [(0.12, 0.25), (0.0, 0.05)],
    "custom_energy": [(19.99, 20.01), (20, 20)],
    "train_env": [(-15.0, 0.0), (20.0, 200.0)],
    "tendon_finger": [(37.2, 38.0), (49.4, 50.2), (1.53, 1.59), (2.12, 2.18), (0.0, 0.1)],
}


def run(name: str, capsys: pytest.CaptureFixture[str]) -> str:
    with warnings.catch_warnings(), unittest.mock.patch("sys.argv", [name]):  # without those of pytest
        warnings.simplefilter("error")
        runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
    return capsys.readouterr().out


QUICK = ["first_gradient", "identify_material", "contact_drop", "custom_energy"]


LONG = "train_env"  # which trains for 20 seconds; tests/envs holds its gradients


@pytest.mark.parametrize("name", [*quick_and_slow(QUICK, [name for name in EXPECTED if name != LONG]),
                                  pytest.param(LONG, marks=pytest.mark.hours)])  # fmt: skip
def test_an_example_prints_the_right_numbers(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(name, capsys)
    numbers = [float(text) for text in NUMBER.findall(printed)]
    assert len(numbers) == len(EXPECTED[name]), printed
    for number, (low, high) in zip(numbers, EXPECTED[name], strict=True):
        assert low <= number <= high, printed
    if name == "first_gradient":
        assert "differences agree: True" in printed


def test_every_example_is_run() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} == set(EXPECTED)
