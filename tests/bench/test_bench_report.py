"""Claim: no page shows a result that cannot be measured again, because its commit is unknown, changed or elsewhere."""

import json
from pathlib import Path
from typing import Any

import pytest

from bench import report
from bench.__main__ import main
from bench.common import cell

HERE, ELSEWHERE = "a" * 40, "b" * 40


def of_here(commit: str) -> bool:
    return HERE.startswith(commit)


@pytest.mark.parametrize("environment", [
    {"commit": HERE, "dirty": False},
    {"commit": HERE, "dirty": None},
    {"commit": HERE[:10], "dirty": None},
], ids=["clean", "without history", "abbreviated"])  # fmt: skip
def test_a_clean_ancestor_is_accepted(environment: dict[str, Any]) -> None:
    assert report.why_refused(environment, of_here) == ""


@pytest.mark.parametrize(
    ("environment", "reason"),
    [
        ({}, "expected the commit that was measured, got none"),
        ({"commit": None, "dirty": None}, "expected the commit that was measured, got none"),
        ({"commit": HERE, "dirty": True}, "changes that were not committed"),
        ({"commit": ELSEWHERE, "dirty": False}, "expected an ancestor of HEAD"),
        ({"commit": ELSEWHERE, "dirty": None}, "expected an ancestor of HEAD"),
    ],
)
def test_any_other_is_refused_with_its_reason(environment: dict[str, Any], reason: str) -> None:
    assert reason in report.why_refused(environment, of_here)


def write(results: Path, **environments: dict[str, Any]) -> None:
    """Results and a log of a task of these names."""
    (results / "tasks").mkdir(exist_ok=True)
    for name, environment in environments.items():
        (results / f"{name.replace('__', '/')}.json").write_text(json.dumps({"environment": environment}))


def test_a_refusal_names_file_commit_and_reason(tmp_path: Path) -> None:
    clean = {"commit": HERE, "dirty": False}
    write(tmp_path, good=clean, changed={**clean, "dirty": True}, tasks__lost={"commit": ELSEWHERE, "dirty": None})
    changed, lost = report.refused(tmp_path, of_here)
    assert changed.startswith(f"changed.json: commit {HERE[:10]} with changes: expected a clean commit")
    assert lost.startswith(f"tasks/lost.json: commit {ELSEWHERE[:10]}: expected an ancestor of HEAD")


def test_groups_that_were_measured_by_themselves_count(tmp_path: Path) -> None:
    clean = {"commit": HERE, "dirty": None}
    results = {"steps": {**clean, "dirty": True, "rows": []}, "regimes": {**clean, "rows": []}, "rate": 3.0}
    (tmp_path / "gpu.json").write_text(json.dumps({"environment": clean, "results": results}))
    (line,) = report.refused(tmp_path, of_here)
    assert line.startswith(f"gpu.json, steps: commit {HERE[:10]} with changes: expected a clean commit")


def test_nothing_is_written_after_a_refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, lost={"commit": None})
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    for page in ("RESULTS_PAGES", "TASKS_PAGE", "PAGE", "CHOOSING_PAGE", "GALLERY_PAGE"):
        monkeypatch.setattr(report, page, tmp_path / f"{page}.md")
    assert main(["report"]) == 1
    assert "lost.json: commit unknown: expected the commit that was measured" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.md"))


def test_results_of_this_repository_have_clean_commits() -> None:
    # without a look at git, which a copy of the tree may lack
    assert report.refused(report.RESULTS, is_ancestor=lambda commit: True) == []


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.00123, "0.00123"),
        (999.6, "1000"),
        (1010.2, "1010"),
        (-15149.0, "-15100"),
        (883127.0, "883000"),
        (2e4, "2e+04"),
        (1.23e6, "1.23e+06"),
        (True, "yes"),
        (None, "-"),
    ],
)
def test_tables_show_thousands_without_an_exponent(value: float | None, text: str) -> None:
    assert cell(value) == text
