"""`python -m bench tasks [--only NAME,...] [--device D] [--seeds 0,1,2] [--options bodies=10000]`.

Runs inverse problems and keeps their logs, each with the machine it ran on, as results/tasks/NAME.json, with device,
options and seed added where they are others; the picture of seed 0 goes to docs/images/tasks. The site's build makes a
page of them.
"""

from __future__ import annotations

import inspect
import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.common import RESULTS, ROOT, as_json, cell, commit, device_suffix, digits, environment, keep_picture, place
from bench.paper import TASKS as PAPER
from bench.tables import markdown_table
from diffvbd.tasks import TASKS, Settings, solve

IMAGES = ROOT / "docs" / "images" / "tasks"


def main(only: str | None, device: str, seeds: str, options: str, out: Path | None, quick: bool) -> int:
    """Runs tasks; one that was interrupted goes on where it stopped."""
    names = list(PAPER) if only is None else [name.strip() for name in only.split(",")]
    if unknown := sorted(set(names) - set(TASKS)):
        print(f"--only: expected names among {', '.join(TASKS)}, got {', '.join(unknown)}", file=sys.stderr)
        return 2
    if quick and out is None:
        print("--out: expected a folder: quick runs are no results", file=sys.stderr)
        return 2
    written = dict(text.partition("=")[::2] for text in options.split(",") if text)
    chosen = {name: TASKS[name].chosen(written) for name in names}
    logs, images = (RESULTS / "tasks", IMAGES) if out is None else (out, out)
    unfinished = ROOT / "runs" / "bench" if out is None else out / "unfinished"
    # what another commit has begun, this one's log must not claim
    unfinished /= str(environment()["commit"])[:10]
    for name in names:
        for seed in (int(s) for s in seeds.split(",")):
            parts = [name + device_suffix(device), *(k + re.sub(r"\W+", "_", v) for k, v in written.items())]
            stem = "-".join(parts) + (f"-seed{seed}" if seed else "")
            settings = Settings(unfinished / stem, device, seed, quick)
            log = {"environment": environment(device), "options": written}
            problem = TASKS[name].build(settings, **chosen[name])
            problem.animation = None
            solve(problem, settings)
            log |= json.loads((settings.out / "log.json").read_text(encoding="utf-8"))
            logs.mkdir(parents=True, exist_ok=True)
            (logs / f"{stem}.json").write_text(as_json(trimmed(log)), encoding="utf-8")
            drawn = settings.out / "picture.png"  # not there without matplotlib
            # where a task runs on both, the picture is that of the CPU
            first_choice = device == "cpu" or not (logs / f"{name}.json").exists()
            if drawn.exists() and first_choice and not (seed or written):
                images.mkdir(parents=True, exist_ok=True)
                keep_picture(drawn, picture_of(name, images))
            print(f"wrote {logs / stem}.json", file=sys.stderr)
            shutil.rmtree(settings.out)
    return 0


def trimmed(log: dict[str, Any]) -> dict[str, Any]:
    """A log whose histories have the digits that a table shows; parameters that a run ended with keep theirs."""
    return log | {"history": [{k: float(f"{v:.6g}") for k, v in row.items()} for row in log["history"]]}


def picture_of(name: str, images: Path) -> Path:
    return images / f"{name.replace('-', '_')}.png"


# --- docs/tasks.md ----------------------------------------------------------------------------------------------------

INTRODUCTION = """\
# tasks

The inverse problems of [tasks](../tasks.md), from their logs in `bench/results/tasks`, which `python -m bench tasks`
writes; the figures of the paper are in `bench/paper.py`.

Times are those of the optimisation, without pictures. Runs are repeatable: on one device the same seed gives the same
numbers, bit by bit. Only parts that run for a given time, such as CMA-ES in learn-controller, depend on the speed of
the machine.

"bar met" judges the result of every run in the table of the task, and the time on the GPU where the paper states one.
The last columns of those tables say when and on which commit a run was made, often an earlier one than the present.
"""


def page(folder: Path, images: Path, root: Path) -> str:
    """The page of all logs in a folder, with pictures from `images`, which lie below the page's folder `root`."""
    logs = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")}
    # the CPU's before a GPU's, without options before with, then by seed
    logs = dict(sorted(logs.items(), key=place_on_page))
    for stem, log in logs.items():
        if not {"environment", "options", "findings", "units", "variables"} <= log.keys():
            raise ValueError(f"{stem}.json: expected a log of `python -m bench tasks`, got an older one; run it again")
    header = ("task", "variables", "the paper", "its iterations", "ours", "evaluations", "CPU [s]", "GPU [s]",
              "bar met")  # fmt: skip
    rows, parts = [], []
    for name in PAPER:
        runs = {key: log for key, log in logs.items() if log["task"] == name}
        if not runs:
            continue
        main_run = runs.get(name) or runs.get(f"{name}-cuda") or next(iter(runs.values()))
        bars, paper = PAPER[name].bars, PAPER[name]
        reached = [(figure(run, key), bar) for run in runs.values() if not run["options"] for key, bar in bars.items()]
        met = [value is not None and value <= bar for value, bar in reached]
        gpu = seconds(runs.get(f"{name}-cuda"))
        late = gpu is not None and paper.seconds is not None and gpu > paper.seconds
        said = "result yes, time no" if late and all(met) else all(met) if met else None
        rows.append((f"[{name}](#{name})", main_run["variables"], paper.outcome, paper.iterations, outcome(main_run),
                     len(main_run["history"]), seconds(runs.get(name)), gpu, said))  # fmt: skip
        parts.append(section(name, runs, main_run, images, root))
    return "\n".join([INTRODUCTION, markdown_table(header, rows), *parts]).rstrip() + "\n"


def place_on_page(entry: tuple[str, dict[str, Any]]) -> tuple[str, int, int, str]:
    stem, log = entry
    return log["settings"]["device"], len(log.get("options", ())), log["settings"]["seed"], stem


def section(name: str, runs: dict[str, Any], main_run: dict[str, Any], images: Path, root: Path) -> str:
    """One task: what it is, its picture, and a row for each run."""
    build = TASKS[name].build
    own = inspect.getdoc(build) or ""
    if "Choices:" not in own:  # then the module says them
        own = (sys.modules[build.__module__].__doc__ or "").strip()
    text = [f"## {name}\n", own + "\n"]
    if (picture := picture_of(name, images)).exists():
        text.append(f"![{TASKS[name].summary}](../{picture.relative_to(root).as_posix()})\n")
    rows = []
    for run in runs.values():
        e, last = run["environment"], run["history"][-1].get("stage", 0)
        # of the last stage: those before it may have other losses
        first = next(row for row in run["history"] if row.get("stage", 0) == last)
        where = place(e) + (f", {e['threads']} threads" if e["device"] == "cpu" else "")
        options = ", ".join(options_of(run)) or "-"
        rows.append((where, options, run["settings"]["seed"], len(run["history"]), first["loss"],
                     run["best"]["loss"], outcome(run), seconds(run), e["torch"], e["date"], commit(e)))  # fmt: skip
    header = ("on", "options", "seed", "evaluations", "first loss of the last stage", "best loss", "result", "seconds",
              "torch", "date", "commit")  # fmt: skip
    text.append(markdown_table(header, rows))
    found = {label(run): dict(flat(run["findings"])) for run in runs.values()}
    keys = list(dict.fromkeys(key for values in found.values() for key in values))
    if keys:
        text.append(markdown_table(("finding", *found), [(key, *(f.get(key) for f in found.values())) for key in keys]))
    return "\n".join(text)


def label(run: dict[str, Any]) -> str:
    """Where a run differs from the others of its task."""
    settings = run["settings"]
    return ", ".join(["CPU" if settings["device"] == "cpu" else "GPU", *options_of(run), f"seed {settings['seed']}"])


def options_of(run: dict[str, Any]) -> list[str]:
    return [f"{key} {value}" for key, value in run["options"].items()]


def flat(values: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers of nested findings with their names; lists are left to the log."""
    for key, value in values.items():
        name = f"{before}{key.replace('_', ' ')}"
        if isinstance(value, dict):
            yield from flat(value, f"{name}: ")
        elif not isinstance(value, list):
            yield name, f"{value:.4g}" if isinstance(value, float) else value


def seconds(run: dict[str, Any] | None) -> float | None:
    return None if run is None else run["history"][-1]["seconds"]


def figure(run: dict[str, Any], key: str) -> float | None:
    """A number of a log: the loss, a relative error, an estimate, a finding, or one of the log itself."""
    for values in ({"loss": run["best"]["loss"]}, run["relative_error"], run["estimates"], run["findings"], run):
        if key in values:
            return values[key]
    return None


def outcome(run: dict[str, Any]) -> str:
    """Errors of what has a true value in per cent, or else the figures that the bars are about."""
    keys = list(PAPER[run["task"]].bars) or list(run["estimates"])
    shown = []
    for key in keys:
        value = figure(run, key)
        if key in run["relative_error"]:
            shown.append(f"{key} {100 * run['relative_error'][key]:.2g} %")
        elif value is not None:
            first = run["history"][0].get(key)
            came = f"{digits(first)} -> " if isinstance(first, float) else ""
            unit = next((unit for name, unit in run["units"].items() if key.startswith(name)), "")
            shown.append(f"{key.replace('_', ' ')} {came}{cell(value)} {unit}".rstrip())
    return ", ".join(shown)
