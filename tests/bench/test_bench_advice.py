"""Claim: `python -m bench advice` compares what was advised with what is true."""

from bench import advice
from bench.advice_scenes import drawn


def test_a_quick_run() -> None:
    results = advice.run(quick=True, only="kept")
    rows = results["kept"]["rows"]
    assert len(rows) == 2
    for row in rows:
        assert row["reached"] and 0 < row["true"] <= row["asked"] and row["unsure"] < 0.5 * row["asked"]
    text = advice.markdown(results)
    assert "Scenes drawn by a seed" in text and rows[0]["scene"] in text


def test_scenes_are_drawn_by_their_number() -> None:
    assert drawn(3).name == drawn(3).name != drawn(4).name
    assert drawn(2).model.floor is not None and drawn(5).model.contact is not None
    assert (drawn(5).v != 0).any() and drawn(0).duration > 0
