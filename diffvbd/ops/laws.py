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
_BIND = ("bind/body", "bind/sweep", "bind/mesh", "bind/contact_coarse")
_CPU = ("bind/body", "cpu/contact", "bind/sweep", "cpu/run", "cpu/coarse", "bind/mesh", "cpu/kernels",
        "bind/contact_coarse")  # fmt: skip
_CUDA = ("coarse", "contact_coarse", "contact_rigid", "begin", "rigid", "coarse_matrix", "arrays")
_COMMON = ("-std=c++20", "-g0", "-fPIC", "-w", "-fvisibility=hidden", "-DTORCH_TARGET_VERSION=0x020b000000000000")
_FLAGS = (*_COMMON, "-fno-math-errno", "-fno-signed-zeros", "-ffp-contract=off", "-DDIFFVBD_NO_CLONES")
_libraries: list[Direct] = []
_numbers: dict[str, int] = {}
_on_cuda: set[str] = set()


def library_of(energies: int) -> Direct:
    """The operators for a scene's mask."""
    number = energies >> LAW_SHIFT
    return _libraries[number - 1] if number else direct


def own_bits(energies: int) -> int:
    """A mask without what only Python reads."""
    return energies & (DECIDES - 1)


def bits_of_law(density: Any, dtype: torch.dtype, device: torch.device, viscous: bool = False) -> int:
    """What a law adds to a mask; compiles and loads it at its first use. density: Its laws.density.Density. viscous:
    Together with the viscosity of a step, whose scalars stand before the law's parameters (step/damping.py).

    Raises:
        RuntimeError: Without a compiler, or with the last lines of what it says.
    """
    scalar = "double" if dtype == torch.float64 else "float"
    header = "#define DIFFVBD_LAW_VISCOUS\n" * viscous + density.header
    name = f"{density.digest}{'v' * viscous}_{scalar}"
    if name not in _numbers:
        torch.ops.load_library(str(_object(name, header, scalar)))
        _libraries.append(Direct(getattr(torch.ops, f"diffvbd_law_{name}")))
        _numbers[name] = len(_libraries)
    if device.type == "cuda" and name not in _on_cuda:
        torch.ops.load_library(str(_object(name, header, scalar, cuda=True)))
        _on_cuda.add(name)
    return _numbers[name] << LAW_SHIFT | (0 if density.quadratic else DECIDES)


def _object(name: str, header: str, scalar: str, cuda: bool = False) -> Path:
    compiler = os.environ.get("CXX", "g++")
    flags = [*_FLAGS, *_native(), "-O1" if os.environ.get("DIFFVBD_QUICK") else "-O3"]
    parts = [compiler, *flags, torch.__version__]
    if cuda:
        parts += [str(torch.version.cuda), *_architectures()]
    digest = hashlib.sha256(" ".join(parts).encode())
    for file in (__file__, Path(__file__).with_name("build_cuda.py")):  # what is compiled, and how
        digest.update(Path(file).read_bytes())
    ends = (".h", ".cpp", ".cu", ".cuh") if cuda else (".h", ".cpp")
    for path in sorted(p for p in sources().rglob("*") if p.suffix in ends):
        digest.update(f"\0{path.name}\0".encode() + path.read_bytes())
    place = extensions_folder() / f"diffvbd-law-{name}-{digest.hexdigest()[:16]}"
    build = _compile_cuda if cuda else _compile
    return locked(place, "law_cuda.so" if cuda else "law.so",
                  lambda folder: build(folder, name, header, scalar, compiler, flags))  # fmt: skip


def _architectures() -> list[str]:
    """Of all visible devices."""
    found = sorted({torch.cuda.get_device_capability(i) for i in range(torch.cuda.device_count())})
    return [f"-gencode=arch=compute_{major}{minor},code=sm_{major}{minor}" for major, minor in found]


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
    root = sources()
    given = _defined(folder, name, header, scalar, compiler)
    print("diffvbd: compiling a law, once for this machine (half a minute)", file=sys.stderr, flush=True)
    sweeps = folder / "sweeps.cpp"  # first: they take longest
    instance = f"template diffvbd::Kernels<{scalar}> diffvbd::baseline::sweep_kernels<{scalar}>();"
    sweeps.write_text(f'#include "{root / "cpu" / "sweep_kernels.h"}"\n{instance}\n', encoding="utf-8")
    command = [*shlex.split(compiler), *flags, *given, *_included("cpu")]
    paths = [sweeps, *(root / f"{path}.cpp" for path in _CPU)]
    return _linked(folder, "law.so", compiler, [(command, path) for path in paths], ["-ltorch_cpu", "-lc10"])


def _compile_cuda(folder: Path, name: str, header: str, scalar: str, compiler: str, flags: list[str]) -> Path:
    from torch.utils.cpp_extension import CUDA_HOME

    from . import build_cuda

    if CUDA_HOME is None:
        raise RuntimeError("diffvbd: a law of your own on CUDA takes nvcc: install the CUDA toolkit, or set CUDA_HOME")
    root = sources()
    given = _defined(folder, name, header, scalar, compiler)
    print("diffvbd: compiling a law for CUDA, once for this machine (minutes)", file=sys.stderr, flush=True)
    paths = []
    for file, text in build_cuda.law_instances(scalar, str(root)).items():
        paths.append(folder / file)
        paths[-1].write_text(text, encoding="utf-8")
    paths += [root / "cuda" / f"{path}.cu" for path in _CUDA]
    nvcc = [str(Path(CUDA_HOME, "bin", "nvcc")), *build_cuda.NVCC_FLAGS, *_architectures(), "-Xcompiler", "-fPIC", "-w",
            *given]  # fmt: skip
    host = [*shlex.split(compiler), *_COMMON, "-O3", "-DUSE_CUDA", *given, *_included("cuda")]
    jobs = [*((nvcc, path) for path in paths), *((host, root / f"{path}.cpp") for path in _BIND)]
    libraries = [f"-L{Path(CUDA_HOME, name)}" for name in ("lib64", "lib")]
    libraries += ["-ltorch_cpu", "-ltorch_cuda", "-lc10", "-lcudart"]
    return _linked(folder, "law_cuda.so", compiler, jobs, libraries)


def _defined(folder: Path, name: str, header: str, scalar: str, compiler: str) -> list[str]:
    """What makes the sources those of the law."""
    if shutil.which(shlex.split(compiler)[0]) is None:
        raise RuntimeError(f"diffvbd: a law of your own takes a C++ compiler, and there is no {compiler!r}: install "
                           "one, or name it by the environment variable CXX")  # fmt: skip
    (folder / "law.h").write_text(header, encoding="utf-8")
    return [f"-Ddiffvbd=diffvbd_law_{name}", f"-DDIFFVBD_SCALAR={scalar}",
            f'-DDIFFVBD_LAW_HEADER="{folder / "law.h"}"']  # fmt: skip


def _included(device: str) -> list[str]:
    from torch.utils.cpp_extension import include_paths

    return [f"-isystem{path}" for path in include_paths(device)]


def _linked(folder: Path, name: str, compiler: str, jobs: list[tuple[list[str], Path]], libraries: list[str]) -> Path:
    """A library of sources, each with its command."""
    from torch.utils.cpp_extension import library_paths

    def run(command: list[str]) -> None:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
        if done.returncode != 0:
            tail = "\n".join(done.stdout.splitlines()[-20:])
            raise RuntimeError(f"diffvbd: the law could not be compiled:\n{tail}")

    def build(job: tuple[list[str], Path]) -> str:
        command, source = job
        target = str(folder / f"{source.parent.name}_{source.stem}.o")
        run([*command, "-c", str(source), "-o", target])
        return target

    threads = int(os.environ.get("MAX_JOBS") or os.cpu_count() or 1)
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        objects = list(pool.map(build, jobs))
    out = folder / name
    run([*shlex.split(compiler), "-shared", "-s", "-o", str(out), *objects, *(f"-L{path}" for path in library_paths()),
         *libraries])  # fmt: skip
    return out


def plain(settings: Any) -> Any:
    """Settings as the operators take them."""
    return settings if settings.energies < DECIDES else settings._replace(energies=own_bits(settings.energies))
