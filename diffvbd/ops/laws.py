"""Objects of generated laws: the operators that read the law, compiled from the same sources with the law's header.

Each law has a library of its own, of which a scene's mask says the number.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from .._common.constants import DECIDES, LAW_SHIFT
from .autograd import Direct, direct
from .load import extensions_folder, locked, sources

# what reads the law; an object is of one scalar, DIFFVBD_SCALAR, which takes half the time
_SOURCES = ("bind/body", "cpu/contact", "bind/sweep", "cpu/run", "cpu/coarse", "bind/mesh", "cpu/kernels",
            "bind/contact_coarse")
_FLAGS = ("-std=c++20", "-g0", "-fPIC", "-w", "-fno-math-errno", "-fno-signed-zeros", "-ffp-contract=off",
          "-fvisibility=hidden", "-DDIFFVBD_NO_CLONES", "-DTORCH_TARGET_VERSION=0x020b000000000000")  # fmt: skip
_libraries: list[Direct] = []
_numbers: dict[tuple[str, str], int] = {}


def library_of(energies: int) -> Direct:
    """The operators for a scene's mask."""
    number = energies >> LAW_SHIFT
    return _libraries[number - 1] if number else direct


def own_bits(energies: int) -> int:
    """A mask without what only Python reads."""
    return energies & (DECIDES - 1)


def bits_of_law(digest: str, header: str, quadratic: bool, dtype: torch.dtype) -> int:
    """What a law adds to a mask; compiles and loads it at its first use. digest: of the header.

    Raises:
        RuntimeError: Without a compiler, or with the last lines of what it says.
    """
    scalar = "double" if dtype == torch.float64 else "float"
    if (digest, scalar) not in _numbers:
        torch.ops.load_library(str(_object(f"{digest}_{scalar}", header, scalar)))
        _libraries.append(Direct(getattr(torch.ops, f"diffvbd_law_{digest}_{scalar}")))
        _numbers[digest, scalar] = len(_libraries)
    return _numbers[digest, scalar] << LAW_SHIFT | (0 if quadratic else DECIDES)


def _object(name: str, header: str, scalar: str) -> Path:
    compiler = os.environ.get("CXX", "g++")
    flags = [*_FLAGS, *_native(), "-O1" if os.environ.get("DIFFVBD_QUICK") else "-O3"]
    digest = hashlib.sha256(" ".join([compiler, *flags, torch.__version__]).encode())
    for path in sorted(p for p in sources().rglob("*") if p.suffix in (".h", ".cpp")):
        digest.update(f"\0{path.name}\0".encode() + path.read_bytes())
    place = extensions_folder() / f"diffvbd-law-{name}-{digest.hexdigest()[:16]}"
    return locked(place, "law.so", lambda folder: _compile(folder, name, header, scalar, compiler, flags))


def _native() -> list[str]:
    """The newest of the instruction sets that the package itself is compiled for, and that this processor has."""
    if platform.machine() != "x86_64" or sys.platform != "linux":
        return []
    text = Path("/proc/cpuinfo").read_text()
    known = set(next((line for line in text.splitlines() if line.startswith("flags")), "").split())
    for level, wanted in {
        "v4": "avx512f avx512bw avx512cd avx512dq avx512vl",
        "v3": "avx2 bmi1 bmi2 f16c fma movbe",
    }.items():
        if known.issuperset(wanted.split()):
            return [f"-march=x86-64-{level}"]
    return []


def _compile(folder: Path, name: str, header: str, scalar: str, compiler: str, flags: list[str]) -> Path:
    from torch.utils.cpp_extension import include_paths, library_paths

    if shutil.which(shlex.split(compiler)[0]) is None:
        raise RuntimeError(f"diffvbd: a law of your own takes a C++ compiler, and there is no {compiler!r}: install "
                           "one, or name it by the environment variable CXX")  # fmt: skip
    print("diffvbd: compiling a law, once for this machine (half a minute)", file=sys.stderr, flush=True)
    (folder / "law.h").write_text(header, encoding="utf-8")
    root = sources()
    sweeps = folder / "sweeps.cpp"  # first: they take longest
    instance = f"template diffvbd::Kernels<{scalar}> diffvbd::baseline::sweep_kernels<{scalar}>();"
    sweeps.write_text(f'#include "{root / "cpu" / "sweep_kernels.h"}"\n{instance}\n', encoding="utf-8")
    given = [sweeps, *(root / f"{path}.cpp" for path in _SOURCES)]
    flags = [*flags, f"-Ddiffvbd=diffvbd_law_{name}", f"-DDIFFVBD_SCALAR={scalar}",
             f'-DDIFFVBD_LAW_HEADER="{folder / "law.h"}"']  # fmt: skip
    flags += [f"-isystem{path}" for path in include_paths()]

    def run(command: list[str]) -> None:
        done = subprocess.run([*shlex.split(compiler), *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                              text=True, errors="replace")  # fmt: skip
        if done.returncode != 0:
            tail = "\n".join(done.stdout.splitlines()[-20:])
            raise RuntimeError(f"diffvbd: the law could not be compiled:\n{tail}")

    def build(source: Path) -> str:
        target = str(folder / f"{source.parent.name}_{source.stem}.o")
        run([*flags, "-c", str(source), "-o", target])
        return target

    jobs = int(os.environ.get("MAX_JOBS") or os.cpu_count() or 1)
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        objects = list(pool.map(build, given))
    out = folder / "law.so"
    run(["-shared", "-s", "-o", str(out), *objects, *(f"-L{path}" for path in library_paths()), "-ltorch_cpu", "-lc10"])
    return out


def plain(settings: Any) -> Any:
    """Settings as the operators take them."""
    return settings if settings.energies < DECIDES else settings._replace(energies=own_bits(settings.energies))
