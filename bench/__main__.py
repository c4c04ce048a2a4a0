"""`python -m bench NAME [--quick] [--out DIR]`, `python -m bench list`.

A benchmark is a module of this package with a function run(quick) that returns a dict, and optionally markdown(results)
that turns it into text. A run that also takes `device`, `only` or `out` gets them from the command line.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import pkgutil
import sys
from pathlib import Path
from types import ModuleType

import bench
from bench import common


def benchmarks() -> dict[str, ModuleType]:
    names = sorted(m.name for m in pkgutil.iter_modules(bench.__path__) if not m.name.startswith("_"))
    modules = {name: importlib.import_module(f"bench.{name}") for name in names}
    return {name: module for name, module in modules.items() if hasattr(module, "run")}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench", description="Runs a benchmark and writes its results.")
    parser.add_argument("name", help="a benchmark, or list")
    parser.add_argument("--quick", action="store_true", help="a few small cases; written only where --out says")
    parser.add_argument("--out", type=Path, help="folder of the results (default: bench/results)")
    parser.add_argument("--device", help="where to measure, if the benchmark lets one choose: cuda, cuda:1, cpu")
    parser.add_argument("--only", help="some groups of the benchmark, if it has any: NAME,...")
    options = parser.parse_args(arguments)
    known = benchmarks()
    if options.name == "list":
        for name, module in known.items():
            print(f"{name:<12} {(module.__doc__ or '').splitlines()[0]}")
        return 0
    if options.name not in known:
        parser.error(f"name: expected one of {', '.join(known)}, or list, got {options.name}")
    module = known[options.name]
    out = options.out or (None if options.quick else common.RESULTS)
    accepted = inspect.signature(module.run).parameters
    chosen = {key: getattr(options, key) for key in ("device", "only") if getattr(options, key) is not None}
    for key in chosen:
        if key not in accepted:
            parser.error(f"--{key}: {options.name} has no such option")
    if "out" in accepted:
        chosen["out"] = out
    results = module.run(options.quick, **chosen)
    text = module.markdown(results) if hasattr(module, "markdown") else ""
    print(text)
    if out is not None:
        device = options.device or getattr(module, "DEVICE", "cpu")
        path = common.write(options.name, results, out, quick=options.quick, text=text, device=device)
        print(f"wrote {path}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
