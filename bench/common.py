"""The one place that writes results: what ran where, and the numbers."""

from __future__ import annotations

import datetime
import io
import json
import math
import multiprocessing
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

import diffvbd as dv

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "bench" / "results"


def environment(device: str = "cpu") -> dict[str, Any]:
    """Machine and versions of a run. Names only: no host, user or path."""
    # a copy of the tree is told by this variable what it is a copy of, whatever history it has
    told = os.environ.get("DIFFVBD_COMMIT")
    commit = told or _git("rev-parse", "HEAD")
    # what benchmarks and pages write changes nothing that the next benchmark measures
    status = None if told else _git("status", "--porcelain", "--", ":/", ":(top,exclude)bench/results",
                                    ":(top,exclude)docs")  # fmt: skip
    gpu = {} if device == "cpu" else {"driver": driver(), "cuda": torch.version.cuda}
    return {
        "device": device if device == "cpu" else torch.cuda.get_device_name(device),
        **gpu,
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "diffvbd": dv.__version__,
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": commit,
        "dirty": None if status is None else status != "",
    }


def cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()


def driver() -> str | None:
    """Version of the NVIDIA driver."""
    lines = _output("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    return lines.splitlines()[0].strip() if lines else None


def is_ancestor(commit: str) -> bool:
    """Whether a commit, or the one that these digits begin, is HEAD or an ancestor of it; False outside of a
    repository."""
    return _git("merge-base", "--is-ancestor", commit, "HEAD") is not None


def _git(*arguments: str) -> str | None:
    """Output of a git command in the repository, or None outside of one."""
    return _output("git", *arguments)


def _output(*command: str) -> str | None:
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def write(name: str, results: Any, out: Path = RESULTS, *, quick: bool = False, device: str = "cpu", suffix: str = ""
          ) -> Path:  # fmt: skip
    """Writes environment and results to NAME.json, with a suffix as "-cuda" of `device_suffix`; returns its path.

    NaN and infinity, which JSON does not have, become strings.
    """
    out.mkdir(parents=True, exist_ok=True)
    content = {"name": name, "quick": quick, "environment": environment(device), "results": results}
    path = out / f"{name}{suffix}.json"
    path.write_text(as_json(_plain(content)), encoding="utf-8")
    return path


def stamp(environment: dict[str, Any]) -> dict[str, Any]:
    """What a group says of its run, where those of one file may be of several."""
    return {
        key: environment.get(key) for key in ("date", "device", "cpu", "driver", "torch", "cuda", "commit", "dirty")
    }


def side_by_side(measure: Callable[..., Any], cases: Iterable[Any], *arguments: Any, at_once: bool
                 ) -> Iterator[tuple[Any, Any]]:  # fmt: skip
    """Each case with measure(case, *arguments), as they are done, with one thread each; at once: on as many cores as
    this process may use."""
    if not at_once:
        for case in cases:
            yield case, measure(case, *arguments)
        return
    os.environ["OMP_NUM_THREADS"] = "1"  # read when a process starts
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with ProcessPoolExecutor(cores, multiprocessing.get_context("spawn")) as pool:
        tasks = {pool.submit(measure, case, *arguments): case for case in cases}
        for task in as_completed(tasks):
            yield tasks[task], task.result()


def earlier(path: Path | None, quick: bool, device: str) -> dict[str, Any]:
    """Groups that runs of the same kind on the same device have left in a file, each with the stamp of its run."""
    if path is None or not path.exists():
        return {}
    content = json.loads(path.read_text(encoding="utf-8"))
    own = content["environment"]
    same = content["quick"] == quick and own["device"] == device
    groups = {name: group for name, group in content["results"].items() if isinstance(group, dict)}
    return {name: stamp(own) | group for name, group in groups.items()} if same else {}


def as_json(content: Any) -> str:
    """JSON with a line for each row of a table, so that it is short and a change of it can be read."""
    return _lines(content, "") + "\n"


def _lines(value: Any, indent: str) -> str:
    children = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if not any(isinstance(child, (dict, list)) for child in children):
        return json.dumps(value, allow_nan=False)
    deeper = indent + " "
    if isinstance(value, dict):
        parts = [f"{json.dumps(key)}: {_lines(child, deeper)}" for key, child in value.items()]
    else:
        parts = [_lines(child, deeper) for child in value]
    start, end = "{}" if isinstance(value, dict) else "[]"
    return f"{start}\n{deeper}" + f",\n{deeper}".join(parts) + f"\n{indent}{end}"


def device_suffix(device: str, home: str = "cpu") -> str:
    """What tells the results of a run on a device from those on the CPU, or on the device that a benchmark is for."""
    kind = torch.device(device).type
    return "" if kind in ("cpu", torch.device(home).type) else f"-{kind}"


def _plain(value: Any) -> Any:
    """Python numbers, lists and dicts, of as many digits as a table needs."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (torch.Tensor, np.ndarray)):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else str(value)
    return value


def cell(value: Any) -> str:
    """A number as it stands in a table."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "-"
    return digits(value) if isinstance(value, float) else str(value)


def digits(value: float) -> str:
    """Three digits without an exponent below a million: 1010 and 15100. Round ones stay, from 1e+04 on."""
    text = f"{value:.3g}"
    whole = "e+" in text and abs(value) < 1e6 and ("." in text or abs(value) < 1e4)
    return f"{float(text):.0f}" if whole else text


def place(environment: dict[str, Any]) -> str:
    """The GPU of a run, or its processor."""
    device = environment.get("device") or "cpu"
    return (environment.get("cpu") or "unknown processor") if device == "cpu" else device


def commit(environment: dict[str, Any]) -> str:
    known = environment.get("commit")
    return "unknown" if not known else known[:10] + (" with changes" if environment.get("dirty") else "")


# --- runs -------------------------------------------------------------------------------------------------------------


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Within, torch uses so many threads; None: as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def chosen(only: str | None, known: Iterable[str]) -> list[str]:
    """The names of `--only`, which semicolons or commas divide, or all."""
    known = list(known)
    # names of some scenes have commas
    names = [name.strip() for name in re.split(";" if any("," in k for k in known) else "[;,]", only or "")]
    names = [name for name in names if name] or known
    if unknown := [name for name in names if name not in known]:
        raise SystemExit(f"only: expected names among {'; '.join(known)}, got {'; '.join(unknown)}")
    return names


def by_group(name: str, groups: dict[str, Callable[[], Any]], *, quick: bool, device: str = "cpu", home: str = "cpu",
             only: str | None = None, out: Path | None = None) -> dict[str, Any]:  # fmt: skip
    """Runs the groups of a benchmark that are chosen, each stamped with its run. Each is written as it ends, beside
    what earlier runs of the same kind on the same device have left of the others."""
    suffix = device_suffix(device, home)
    path = None if out is None else out / f"{name}{suffix}.json"
    results = earlier(path, quick, environment(device)["device"])
    for group in chosen(only, groups):
        began = time.perf_counter()
        rows = groups[group]()
        if not rows:  # a group that does not measure there
            continue
        seconds = time.perf_counter() - began
        results[group] = {"rows": rows, "seconds": seconds, **stamp(environment(device))}
        print(f"{group}: {seconds:.1f} s", file=sys.stderr, flush=True)
        if out is not None:
            write(name, {g: results[g] for g in groups if g in results}, out, quick=quick, device=device, suffix=suffix)
    return {group: results[group] for group in groups if group in results}


def keep_picture(drawn: Path | io.BytesIO, to: Path, width: int = 1200) -> None:
    """A picture for the repository: at most so many pixels wide and in 64 colors, an eighth of the bytes."""
    from PIL import Image  # matplotlib needs it, too

    picture = Image.open(drawn).convert("RGB")
    picture.thumbnail((width, width))
    to.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(64).save(to, optimize=True)
