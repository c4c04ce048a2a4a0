"""Claim: the page of inverse problems says what the logs say, and nothing else; the gallery shows all animations."""

import json
from pathlib import Path

import pytest
from helpers.task_checks import timeless

from bench import gallery, report, tasks
from bench.__main__ import main
from bench.paper import TASKS as PAPER
from diffvbd.tasks import TASKS


def test_a_run_is_kept_with_its_machine_and_shown(tmp_path: Path) -> None:
    assert main(["tasks", "--only", "beam-mu", "--seeds", "0,1", "--quick", "--out", str(tmp_path)]) == 0
    logs = {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("*.json")}
    assert set(logs) == {"beam-mu", "beam-mu-seed1"}
    log = logs["beam-mu"]
    assert log["environment"]["device"] == "cpu" and log["settings"]["seed"] == 0 and log["options"] == {}
    assert logs["beam-mu-seed1"]["settings"]["seed"] == 1
    # no randomness in this one: two runs give the same numbers
    assert timeless(logs["beam-mu"]["history"]) == timeless(logs["beam-mu-seed1"]["history"])

    page = tasks.page(tmp_path, tmp_path, tmp_path)
    (row,) = [line for line in page.splitlines() if line.startswith("| [beam-mu]")]
    assert f"mu {100 * log['relative_error']['mu']:.2g} %" in row and row.endswith("| yes |")
    assert "A cantilever of 0.5 x 0.2 x 0.2 m" in page
    # one run of several that misses the bar counts
    logs["beam-mu-seed1"]["relative_error"]["mu"] = 2e-3
    (tmp_path / "beam-mu-seed1.json").write_text(json.dumps(logs["beam-mu-seed1"]))
    (row,) = [line for line in tasks.page(tmp_path, tmp_path, tmp_path).splitlines() if line.startswith("| [beam-mu]")]
    assert row.endswith("| no |")


def test_options_are_part_of_the_name_and_do_not_count_for_the_bar(tmp_path: Path) -> None:
    run = ["tasks", "--quick", "--out", str(tmp_path), "--only"]
    assert main([*run, "million-cubes", "--options", "bodies=8,iterations=2", "--seeds", "3"]) == 0
    stem = "million-cubes-bodies8-iterations2-seed3"
    log = json.loads((tmp_path / f"{stem}.json").read_text())
    assert log["options"] == {"bodies": "8", "iterations": "2"} and log["protocol"]["bodies"] == 8
    page = tasks.page(tmp_path, tmp_path, tmp_path)
    (row,) = [line for line in page.splitlines() if line.startswith("| [million-cubes]")]
    assert row.endswith("| - |") and "bodies 8, iterations 2 | 3 | 4 |" in page
    for options, expected in (
        ("bodies=many", "--bodies: expected int, got 'many'"),
        ("radius=1", "--radius: expected"),
    ):
        with pytest.raises(ValueError, match=expected):
            main([*run, "million-cubes", "--options", options])


@pytest.mark.parametrize("name", PAPER)
def test_every_bar_is_met_by_the_logs(name: str) -> None:
    logs = [json.loads(path.read_text(encoding="utf-8")) for path in (tasks.RESULTS / "tasks").glob(f"{name}*.json")]
    runs = [log for log in logs if log["task"] == name and not log["options"]]
    assert runs
    for key, bar in PAPER[name].bars.items():
        for run in runs:
            value = tasks.figure(run, key)
            assert value is not None and value <= bar, (key, run["settings"])


@pytest.mark.parametrize("arguments", [["--only", "beam"], ["--only", "beam-mu", "--quick"]])
def test_what_cannot_be_run_is_refused(arguments: list[str], capsys: pytest.CaptureFixture) -> None:
    assert main(["tasks", *arguments]) == 2
    assert "expected" in capsys.readouterr().err


def test_every_task_is_on_the_page_and_the_page_is_made_of_the_logs() -> None:
    assert set(PAPER) == set(TASKS)
    text = report.TASKS_PAGE.read_text(encoding="utf-8")
    assert text == tasks.page(report.RESULTS / "tasks", tasks.IMAGES, report.ROOT / "docs"), (
        "run `python -m bench report`"
    )
    cards = report.GALLERY_PAGE.read_text(encoding="utf-8")
    assert cards == report.filled(cards, tasks.gallery(report.RESULTS / "tasks")), "run `python -m bench report`"
    for name in PAPER:
        assert f"\n## {name}\n" in text
        assert f"}} {name}\n" in cards
        assert tasks.picture_of(name, tasks.IMAGES).exists()
        assert (report.RESULTS / "tasks" / f"{name}.json").exists() or name == "million-cubes"


def test_every_animation_is_rendered_by_the_bench_and_shown() -> None:
    shown = {path.stem for path in gallery.FOLDER.glob("*.webp")}
    assert shown == set(gallery.SCENES)
    assert {name for name in PAPER if name.replace("-", "_") in shown}, "animations are named after their problems"
    cards = report.GALLERY_PAGE.read_text(encoding="utf-8")
    for name in shown:
        assert f"](images/gallery/{name}.webp)" in cards
