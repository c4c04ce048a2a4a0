"""Marks of single cases in a list of parameters."""

from collections.abc import Iterable
from typing import Any

import pytest


def slow(*values: Any) -> Any:
    """A case that only `make test-all` runs: it repeats the claim of the others at greater length."""
    return pytest.param(*values, marks=pytest.mark.slow)


def hours(*values: Any) -> Any:
    """A case that is run by hand before a release, like the others at still greater length."""
    return pytest.param(*values, marks=pytest.mark.hours)


def quick_and_slow(quick: Iterable[Any], every: Iterable[Any]) -> list[Any]:
    """The values of `every` for one argument, slow where they are not among the quick ones."""
    quick = list(quick)
    return [value if value in quick else slow(value) for value in every]
