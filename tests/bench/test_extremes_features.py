"""Extremes of corrections, integrators and contact are finite, cross nothing and are not silent: the quick part of
`python -m bench extremes_features`."""

import pytest

from bench import extremes_features as features

QUICK = [case for case in features.CASES if case.axis in features.QUICK]
FEW = ("coarse, free", "BDF2, free", "floor, friction", "pairs, friction")


def check(case: features.Extreme) -> None:
    row = features.check(case)
    assert row["finite"] and not row["raised"], row
    assert not row["silent"], row
    assert row["crossings"] == 0, row
    if case.axis == "none":
        assert row["gain"] <= features.GAIN, row
        assert features.verdict(row) == "alike", row


@pytest.mark.parametrize("case", [c for c in QUICK if c.feature in FEW], ids=lambda c: f"{c.feature}: {c.axis}")
def test_a_few(case: features.Extreme) -> None:
    check(case)


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in QUICK if c.feature not in FEW], ids=lambda c: f"{c.feature}: {c.axis}")
def test_the_others(case: features.Extreme) -> None:
    check(case)


def test_what_is_of_no_use_is_seen() -> None:
    """The figures can tell: a stiff bar bent by few sweeps gains energy, and that is warned of."""
    (case,) = [c for c in QUICK if (c.feature, c.axis) == ("plain, free", "mu 1e10 Pa, K = 1")]
    row = features.check(case)
    assert row["useless"] and row["warned"] == "sweeps" and row["gain"] > 1
    text = features.markdown({"rows": [row, {**row, "warned": "", "silent": True}]})
    assert "## Of no use, and nothing said" in text and "## Of no use, and said so" in text
