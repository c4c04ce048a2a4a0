"""Loads the compiled objects, and compiles the CUDA one at its first use where DIFFVBD_JIT=1 asks for it."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch

_FOLDER = Path(__file__).parents[1]  # of the package, where the objects are
_COMMAND = "pip install --no-build-isolation -e ."  # in a checkout
_cuda = False
_why_not = ""  # what the loader said of a CUDA object that is there and does not load


def load() -> None:
    """Loads ``_C`` and, with a torch that has CUDA, ``_C_cuda`` if it was built.

    Raises:
        ImportError: If ``_C`` was not built. A missing CUDA object is no error before somebody needs it.
    """
    global _why_not
    path = _built("_C")
    if path is None:
        raise ImportError(
            f"diffvbd is not built here: run `{_COMMAND}` in this folder, or, if it is installed elsewhere, leave this "
            "folder, whose sources hide the installed package"
        )
    torch.ops.load_library(str(path))
    if not hasattr(torch.ops.diffvbd, "constants"):
        raise ImportError(f"diffvbd was built from older sources: run `{_COMMAND}` in this folder")
    path = _built("_C_cuda")
    if torch.version.cuda and path is not None:
        try:
            _load_cuda(path)
        except OSError as error:  # made for another torch or CUDA: the CPU must go on working
            _why_not = " ".join(str(error.__cause__ or error).split())


def has_cuda() -> bool:
    """Whether the CUDA object is loaded; a device may still be missing."""
    return _cuda


def require_cuda() -> None:
    """Returns with the CUDA object loaded; compiles it if need be where DIFFVBD_JIT=1.

    Raises:
        RuntimeError: If there is none, in one line that names the command that builds it.
    """
    if _cuda:
        return
    if not torch.version.cuda:
        raise RuntimeError(
            f"diffvbd: torch {torch.__version__} has no CUDA: install a CUDA build of torch, then set DIFFVBD_JIT=1 "
            f"(takes nvcc), or run `{_COMMAND}` in a checkout"
        )
    if os.environ.get("DIFFVBD_JIT", "0") not in ("", "0"):
        _load_cuda(jit_build())
        return
    state = f"has a CUDA object that does not load ({_why_not})" if _why_not else "was built without CUDA"
    raise RuntimeError(f"diffvbd {state}: set DIFFVBD_JIT=1 where nvcc is, or run `{_COMMAND}` in a checkout there")


def jit_build() -> Path:
    """The CUDA object of these sources, torch, CUDA and architectures from the cache; compiled if it is not there.

    Raises:
        RuntimeError: If it does not compile; the message ends with the compiler's last lines.
    """
    return locked(_jit_folder(), "_C_cuda.so", _compile)


def locked(place: Path, name: str, build: Callable[[Path], Path]) -> Path:
    """A file of a folder, built if it is not there: build(an empty folder) returns the path to take it from.

    Several processes may ask at once: one builds, the others wait for it. A process that is killed, at any moment,
    leaves nothing that the next one would wait for or take for the file.
    """
    import fcntl  # not on Windows

    target = place / name
    if target.exists():
        return target
    place.mkdir(parents=True, exist_ok=True)
    # flock, not a file that is created and deleted: the kernel releases it with the process
    with open(place / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not target.exists():
            for left_behind in place.glob("build-*"):
                shutil.rmtree(left_behind, ignore_errors=True)
            with tempfile.TemporaryDirectory(prefix="build-", dir=place) as folder:
                os.replace(build(Path(folder)), target)
    return target


def _compile(folder: Path) -> Path:
    shutil.copytree(sources(), folder / "csrc")
    shutil.copy(_FOLDER / "ops" / "build_cuda.py", folder)
    print("diffvbd: compiling the CUDA object, once for this machine (minutes)", file=sys.stderr, flush=True)
    # torch finds ninja through PATH alone, and the environment's own need not be there
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    done = subprocess.run(
        [sys.executable, "build_cuda.py"],
        cwd=folder,
        env={**os.environ, "PATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
    built = list((folder / "lib").rglob("_C_cuda*.so"))
    if done.returncode != 0 or len(built) != 1:
        tail = "\n".join(done.stdout.splitlines()[-20:])
        raise RuntimeError(f"diffvbd: DIFFVBD_JIT=1 could not compile the CUDA object:\n{tail}")
    return built[0]


def _jit_folder() -> Path:
    from .._version import __version__
    from .build_cuda import architectures

    root = sources()
    digest = hashlib.sha256(architectures().encode())
    for path in [_FOLDER / "ops" / "build_cuda.py", *sorted(p for p in root.rglob("*") if p.is_file())]:
        digest.update(f"\0{path.name}\0".encode() + path.read_bytes())
    name = f"diffvbd-{__version__}-torch{torch.__version__}-cuda{torch.version.cuda}-{digest.hexdigest()[:16]}"
    return extensions_folder() / name


def extensions_folder() -> Path:
    """Where torch keeps what it compiles."""
    from torch.utils.cpp_extension import get_default_build_root

    return Path(os.environ.get("TORCH_EXTENSIONS_DIR") or get_default_build_root())


def sources() -> Path:
    """csrc: inside an installed package, beside the package in a checkout."""
    for path in (_FOLDER / "csrc", _FOLDER.parent / "csrc"):
        if (path / "bind").exists():
            return path
    raise RuntimeError(f"diffvbd: DIFFVBD_JIT=1 finds no sources beside {_FOLDER}: run `{_COMMAND}`")


def _built(name: str) -> Path | None:
    for suffix in (".abi3.so", sysconfig.get_config_var("EXT_SUFFIX") or ".so"):
        path = _FOLDER / f"{name}{suffix}"
        if path.exists():
            return path
    return None


def _load_cuda(path: Path) -> None:
    global _cuda
    torch.ops.load_library(str(path))
    _cuda = True


load()
raw = torch.ops.diffvbd
