"""`python -m bench NAME [--quick] [--device D] [--out DIR]`; NAME may also be list, all, tasks, report, gallery or
screenshots.

A benchmark is a module of this package with a function run(quick) that returns a dict, and optionally markdown(results)
that turns it into text. A run that also takes `device`, `only` or `out` gets them from the command line. Results go to
NAME.json and NAME.md, of a run on CUDA to NAME-cuda.json and NAME-cuda.md; `report` makes docs/results of all, and
docs/tasks.md of the logs of inverse problems, which `tasks` runs. `gallery` and `screenshots` make pictures.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import pkgutil
import sys
import traceback
from pathlib import Path
from types import ModuleType

import torch

import bench
from bench import common, gallery, report, screenshots, tasks

ASKED = ("bits",)  # only when they are asked for by name: what is written is no result
PAPER = ("exactness", "ablation", "cost", "fd", "generality")  # the paper's own measurements, in its order


def benchmarks() -> dict[str, ModuleType]:
    names = sorted(m.name for m in pkgutil.iter_modules(bench.__path__) if not m.name.startswith("_"))
    modules = {name: importlib.import_module(f"bench.{name}") for name in names}
    return {name: module for name, module in modules.items() if hasattr(module, "run")}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench", description="Runs a benchmark and writes its results.")
    parser.add_argument(
        "name", help="a benchmark; all: the paper's, then the others; tasks, report, gallery, screenshots, list"
    )
    parser.add_argument("--quick", action="store_true", help="a few small cases; written only where --out says")
    parser.add_argument("--out", type=Path, help="folder of the results (default: bench/results); report reads it, too")
    parser.add_argument("--device", help="where to measure, if the benchmark lets one choose: cuda, cuda:1, cpu")
    parser.add_argument("--only", help="some groups of the benchmark, if it has any, or some of all: NAME,...")
    parser.add_argument("--seeds", default="0", help="of the inverse problems that `tasks` runs: N,... (default 0)")
    parser.add_argument("--options", default="", help="of the inverse problems that `tasks` runs: bodies=10000,...")
    options = parser.parse_args(arguments)
    if options.name == "report":
        return report.main(options.out)
    if options.device and torch.device(options.device).type == "cuda" and not torch.cuda.is_available():
        parser.error(f"--device: expected a device of this machine, got {options.device}, and torch sees no CUDA here")
    if options.name == "gallery":
        return gallery.main(options.only, options.out)
    if options.name == "screenshots":
        return screenshots.main(options.out)
    if options.name == "tasks":
        return tasks.main(
            options.only, options.device or "cpu", options.seeds, options.options, options.out, options.quick
        )
    known = benchmarks()
    if options.name == "list":
        for name, module in known.items():
            print(f"{name:<12} {(module.__doc__ or '').splitlines()[0]}")
        return 0
    if options.name == "all":
        return run_all(parser, options, known)
    if options.name in ASKED and options.out is None:
        parser.error(f"--out: {options.name} is compared between two folders, and needs one")
    if options.name not in known:
        others = "all, tasks, report, gallery, screenshots or list"
        parser.error(f"name: expected one of {', '.join(known)}, {others}, got {options.name}")
    accepted = inspect.signature(known[options.name].run).parameters
    for key in ("device", "only"):
        if getattr(options, key) is not None and key not in accepted:
            parser.error(f"--{key}: {options.name} has no such option")
    run_one(options.name, known[options.name], options, options.only)
    return 0


def run_one(name: str, module: ModuleType, options: argparse.Namespace, only: str | None = None) -> None:
    out = options.out or (None if options.quick else common.RESULTS)
    given = {"device": options.device, "only": only, "out": out}
    accepted = inspect.signature(module.run).parameters
    results = module.run(options.quick, **{k: v for k, v in given.items() if v is not None and k in accepted})
    text = module.markdown(results) if hasattr(module, "markdown") else ""
    print(text)
    if out is not None:
        home = getattr(module, "DEVICE", "cpu")
        device = options.device or home
        path = common.write(name, results, out, quick=options.quick, text=text, device=device,
                            suffix=common.device_suffix(device, home))  # fmt: skip
        print(f"wrote {path}", file=sys.stderr)


def run_all(parser: argparse.ArgumentParser, options: argparse.Namespace, known: dict[str, ModuleType]) -> int:
    """The paper's measurements, then the others that the device allows. One that fails does not keep back the next."""
    others = [name for name in known if name not in PAPER and name not in ASKED]
    names = [name for name in PAPER if name in known] + others
    if options.only is not None:
        chosen = [name.strip() for name in options.only.split(",")]
        if unknown := [name for name in chosen if name not in known]:
            parser.error(f"--only: expected names among {', '.join(names)}, got {', '.join(unknown)}")
        names = [name for name in names if name in chosen]
    failed = []
    for name in names:
        if reason := _why_not(known[name], options.device):
            print(f"{name}: left out, {reason}", file=sys.stderr)
            continue
        print(f"# {name}\n", flush=True)
        try:
            run_one(name, known[name], options)
        except Exception:
            traceback.print_exc()
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _why_not(module: ModuleType, device: str | None) -> str:
    """Why `all` leaves a benchmark out, or an empty string."""
    home = getattr(module, "DEVICE", "cpu")
    if home != "cpu" and not torch.cuda.is_available():
        return "it needs a CUDA device"
    takes_device = "device" in inspect.signature(module.run).parameters
    wanted = torch.device(device or home).type
    if wanted != home and (not takes_device or home != "cpu"):
        return f"it does not measure on {wanted}"
    return ""


if __name__ == "__main__":
    sys.exit(main())
