"""`python -m bench NAME [--quick] [--device D] [--only GROUP,...] [--out DIR]`: the one runner of all benchmarks.

A benchmark is a module with run(quick) that returns its results, or with GROUPS, functions of a Card by name. Its
docstring and its TABLES say how the site shows them (`bench.tables`). DEVICE is where it measures without `--device`,
THREADS how many torch uses. Results go to NAME.json, those on CUDA to NAME-cuda.json. Other names: list; all; `tasks`,
inverse problems and their logs; `report`, what pages in the repository show of results.
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
from typing import Any

import torch

import bench
from bench import common, report, tables, tasks
from bench.measure import Card

ASKED = ("bits",)  # only when asked for by name: what it writes is no result
PAPER = ("exactness", "ablation", "cost", "fd")  # the paper's own measurements, in its order


def benchmarks() -> dict[str, ModuleType]:
    names = sorted(m.name for m in pkgutil.iter_modules(bench.__path__) if not m.name.startswith("_"))
    modules = {name: importlib.import_module(f"bench.{name}") for name in names}
    return {name: module for name, module in modules.items() if hasattr(module, "run") or hasattr(module, "GROUPS")}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench", description="Runs a benchmark and writes its results.")
    parser.add_argument("name", help="a benchmark; all: the paper's, then the others; list, tasks, report")
    parser.add_argument("--quick", action="store_true", help="a few small cases; written only where --out says")
    parser.add_argument("--out", type=Path, help="folder of the results (default: bench/results)")
    parser.add_argument("--device", help="where to measure, if the benchmark lets one choose: cuda, cuda:1, cpu")
    parser.add_argument("--only", help="some groups of the benchmark, if it has any, or some of all: NAME,...")
    parser.add_argument("--seeds", default="0", help="of the inverse problems that `tasks` runs: N,... (default 0)")
    parser.add_argument("--options", default="", help="of the inverse problems that `tasks` runs: bodies=10000,...")
    options = parser.parse_args(arguments)
    if options.device and torch.device(options.device).type == "cuda" and not torch.cuda.is_available():
        parser.error(f"--device: expected a device of this machine, got {options.device}, and torch sees no CUDA here")
    if options.name == "report":
        return report.main()
    if options.name == "tasks":
        return tasks.main(options.only, options.device or "cpu", options.seeds, options.options, options.out,
                          options.quick)  # fmt: skip
    if (Path(__file__).parent / f"{options.name}.py").exists():
        known = {options.name: importlib.import_module(f"bench.{options.name}")}
    else:
        known = benchmarks()
    if options.name == "list":
        for name, module in known.items():
            print(f"{name:<15} {(module.__doc__ or '').splitlines()[0]}")
        return 0
    if options.name == "all":
        return run_all(options, known)
    if options.name in ASKED and options.out is None:
        parser.error(f"--out: {options.name} is compared between two folders, and needs one")
    module = known.get(options.name)
    if module is None or not (hasattr(module, "run") or hasattr(module, "GROUPS")):
        parser.error(f"name: expected one of {', '.join(benchmarks())}, all, list, report, tasks, got {options.name}")
    if options.only is not None and "only" not in takes(module) or not on_device(module, options.device):
        parser.error(f"--only, --device: {options.name} has no such option")
    run_one(options.name, module, options, options.only)
    return 0


def takes(module: ModuleType) -> set[str]:
    """The options that a benchmark has."""
    if hasattr(module, "GROUPS"):
        return {"only", "device"} if getattr(module, "ANYWHERE", False) else {"only"}
    return set(inspect.signature(module.run).parameters)


def on_device(module: ModuleType, device: str | None) -> bool:
    """Whether a benchmark can measure there."""
    return not device or torch.device(device).type == getattr(module, "DEVICE", "cpu") or "device" in takes(module)


def run_one(name: str, module: ModuleType, options: argparse.Namespace, only: str | None = None) -> None:
    out = options.out or (None if options.quick else common.RESULTS)
    home = getattr(module, "DEVICE", "cpu")
    device = options.device or home
    with common.threads(getattr(module, "THREADS", None)):
        if hasattr(module, "GROUPS"):
            card = Card(torch.device(device), options.quick)
            groups = {key: lambda make=make: make(card) for key, make in module.GROUPS.items()}
            results: Any = common.by_group(name, groups, quick=options.quick, device=device, home=home, only=only,
                                           out=out)  # fmt: skip
        else:
            given = {"device": options.device, "only": only, "out": out}
            known = takes(module)
            results = module.run(options.quick, **{k: v for k, v in given.items() if v is not None and k in known})
    print(tables.text_of(name, results))
    if out is not None:
        suffix = common.device_suffix(device, home)
        path = common.write(name, results, out, quick=options.quick, device=device, suffix=suffix)
        print(f"wrote {path}", file=sys.stderr)


def run_all(options: argparse.Namespace, known: dict[str, ModuleType]) -> int:
    """The paper's measurements, then the others that the device allows. One that fails does not keep back the next."""
    names = [*PAPER, *(name for name in known if name not in PAPER and name not in ASKED)]
    names, failed = [name for name in names if name in common.chosen(options.only, known)], []
    for name in names:
        home = getattr(known[name], "DEVICE", "cpu")
        device = options.device or home
        if torch.device(device).type == "cuda" and not torch.cuda.is_available() or not on_device(known[name], device):
            print(f"{name}: left out, it does not measure on {device} here", file=sys.stderr)
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


if __name__ == "__main__":
    sys.exit(main())
