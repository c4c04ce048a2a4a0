"""`python -m bench NAME [--quick] [--out DIR]`, `python -m bench list`.

A benchmark is a module of this package with a function run(quick) that returns a dict, and optionally markdown(results)
that turns it into text.
"""

from __future__ import annotations

import argparse
import importlib
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
    options = parser.parse_args(arguments)
    known = benchmarks()
    if options.name == "list":
        for name, module in known.items():
            print(f"{name:<12} {(module.__doc__ or '').splitlines()[0]}")
        return 0
    if options.name not in known:
        parser.error(f"name: expected one of {', '.join(known)}, or list, got {options.name}")
    module = known[options.name]
    results = module.run(options.quick)
    text = module.markdown(results) if hasattr(module, "markdown") else ""
    print(text)
    if options.out or not options.quick:
        path = common.write(options.name, results, options.out or common.RESULTS, quick=options.quick, text=text)
        print(f"wrote {path}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
