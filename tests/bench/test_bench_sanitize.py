"""Claim: the scenes of `bench sanitize` step and have gradients on any device, and what its tools find is counted."""

import pytest

from bench import sanitize


@pytest.mark.parametrize("counts", [(sanitize.STEPS, sanitize.SWEEPS), *sanitize.LESS.values()])
@pytest.mark.parametrize("name", sanitize.SCENES)
def test_scenes(name: str, counts: tuple[int, int], device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sanitize, "DEVICE", device)
    sanitize.step_of(sanitize.SCENES[name], *counts)


def test_summaries() -> None:
    texts = {
        "========= ERROR SUMMARY: 3 errors\n": 3,
        "========= ERROR SUMMARY: 1 error\n": 1,
        "========= RACECHECK SUMMARY: 2 hazards displayed (1 error, 1 warning)\n": 2,
        "done thread\n": 0,
    }
    for text, count in texts.items():
        assert sum(int(a or b) for a, b in sanitize.SUMMARY.findall(text)) == count
    lines = ("COMPUTE-SANITIZER", "Invalid read", "    at f(int)", "ERROR SUMMARY: 1 error")
    text = "".join(f"========= {line}\n" for line in lines)
    assert sanitize._first(text) == "Invalid read | at f(int)"
