"""Files of a run: its folder, archives of arrays, and the ranks of torchrun, of which the first keeps files."""

import contextlib
import gc
import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist

from diffvbd.tasks.problem import Settings

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

RESULTS = ("log.json", "picture.png", "animation.gif", "motion.npz", "parameters.pt")  # files of a run
STATE = "state.pt"  # of an unfinished one


def _make(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"out: expected a folder or a place for one, got {out} ({error.strerror})") from None


@contextlib.contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Makes a folder that one run at a time works in; ValueError for no folder, or one that another run works in.

    The system keeps the lock for as long as the process lives, on the folder itself: no file is left behind by a crash.
    """
    _make(out)
    if fcntl is None:
        yield
        return
    handle = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"out: expected a folder that no other run works in, got {out}: wait for that run, or "
                             "choose another folder") from None  # fmt: skip
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(handle)


def prepare(out: Path, task: str) -> None:
    """Make the folder, or make sure that what lies in it may be replaced: ValueError for no folder, one that cannot be
    written to, or one with results of another task or of something else."""
    _make(out)
    if not os.access(out, os.W_OK | os.X_OK):
        raise ValueError(f"out: expected a folder that can be written to, got {out}")
    there = [name for name in RESULTS if (out / name).exists()]
    if there and (found := _task_of(out / "log.json")) != task:
        whose = f"{', '.join(there)} of {found or 'something else'}"
        raise ValueError(f"out: expected a folder without results, or with those of {task}, got {out} with {whose}")
    for name in map(Path, (*RESULTS, STATE)):
        for unfinished in out.glob(f"{name.stem}.[0-9]*.part{name.suffix}"):
            unfinished.unlink()


def _task_of(log: Path) -> str | None:
    try:
        return str(json.loads(log.read_text(encoding="utf-8"))["task"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def remove_results(out: Path) -> None:
    for name in RESULTS:
        (out / name).unlink(missing_ok=True)


def put_aside(state: Path) -> Path:
    """Give a state that is not continued a name that no other has; returns its new path."""
    aside, k = state.with_name("state.other.pt"), 1
    while aside.exists():
        aside, k = state.with_name(f"state.other-{k + 1}.pt"), k + 1
    return state.rename(aside)


def is_first() -> bool:
    """True for the process that keeps files: alone, or the first of its group."""
    return not dist.is_initialized() or dist.get_rank() == 0


@contextlib.contextmanager
def joined(device: str, splits: bool) -> Iterator[None]:
    """Inside, the processes that torchrun has started are one group; a process on its own stays so. ValueError for
    several processes of a task that does not split, and for a CUDA device by its number: each rank takes its own."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    if not splits:
        raise ValueError("torchrun: expected a task that ranks can share (million-cubes): run this one without it")
    cuda = torch.device(device).type == "cuda"
    if cuda:
        if torch.device(device).index is not None:
            raise ValueError(f"device: expected cuda, of which each rank takes its own, got {device}")
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("nccl" if cuda else "gloo")
    yield
    gc.collect()  # CUDA graphs that hold what is destroyed now
    dist.destroy_process_group()  # not after an error: other ranks may wait for this one, and torchrun ends them


@contextlib.contextmanager
def with_own_folder(settings: Settings) -> Iterator[Settings]:
    """Settings whose folder no other rank writes to: that of the first rank is the user's, those of the others are
    thrown away. All begin with the state that the first one has found."""
    if not dist.is_initialized() or dist.get_world_size() == 1:
        yield settings
        return
    state = settings.out / STATE
    found = [state.read_bytes() if is_first() and state.exists() else None]
    dist.broadcast_object_list(found, src=0)
    if is_first():
        yield settings
        return
    with tempfile.TemporaryDirectory() as folder:
        if found[0] is not None:
            (Path(folder) / STATE).write_bytes(found[0])
        yield replace(settings, out=Path(folder))


MOST_BYTES = 4 << 30  # of all arrays together, unpacked: 1000 frames of 150,000 vertices
_DAMAGED = (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError, AttributeError, TypeError, KeyError,
            MemoryError, RuntimeError, OverflowError)  # fmt: skip


def read_archive(path: str | Path, expected: str) -> dict[str, Any]:
    """All arrays of an .npz file. OSError where it cannot be opened; ValueError where it is none, is damaged, or has
    more than MOST_BYTES when unpacked, looked at before it is."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MOST_BYTES:
            raise ValueError(f"{path}: expected at most {MOST_BYTES} bytes of arrays, got {size} when unpacked")
        with np.load(path, allow_pickle=False) as content:
            return dict(content)
    except _DAMAGED:
        raise ValueError(f"{path}: expected {expected}") from None
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: expected {expected}") from None
