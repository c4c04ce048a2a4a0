"""Claim: the scenes of `bench sanitize` step and have gradients on any device, and what its tools find is counted."""

import pytest

from bench import sanitize


@pytest.mark.parametrize(
    "counts", [(sanitize.STEPS, sanitize.SWEEPS), *sanitize.LESS.values(), *sanitize.LEAST.values()]
)
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


@pytest.mark.parametrize(
    ("tool", "counts", "found", "once"),
    [
        ("initcheck", [0], 0, ""),
        ("initcheck", [2, 1, 1], 1, ""),
        ("initcheck", [2, 0], 0, "a read"),
        ("initcheck", [2, 1, 0], 0, "a read"),
        ("initcheck", [None], None, ""),
        ("initcheck", [2, None, 1], 1, ""),
        ("memcheck", [2], 2, ""),
    ],
)
def test_initcheck_counts_what_it_finds_in_each_of_three_runs(
    monkeypatch: pytest.MonkeyPatch, tool: str, counts: list[int | None], found: int | None, once: str
) -> None:
    left = list(counts)

    def run(tool: str, name: str, device: str) -> dict[str, object]:
        count = left.pop(0)
        return {"scene": name, "found": count, "first": "a read" if count else ""}

    monkeypatch.setattr(sanitize, "_of_process", run)
    result = sanitize._of_processes(tool, "pairs", "cuda")
    assert (result["found"], result["once"], left) == (found, once, [])


@pytest.mark.parametrize("only", ["nonsense", "initcheck;typo", "pairs;typo"])
def test_unknown_names_are_refused(only: str) -> None:
    with pytest.raises(SystemExit, match=f"only: expected names among .*got {only.rpartition(';')[2]}"):
        sanitize.run(False, only=only)
