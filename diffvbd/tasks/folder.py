"""The folder of a run: what may lie there before it, and how its files are written."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

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
    """Makes a folder that one run at a time works in.

    The system keeps the lock for as long as the process lives, on the folder itself: no file is left behind by a crash.

    Raises:
        ValueError: no folder, or one that another run works in.
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
    """Make the folder, or make sure that what lies in it may be replaced.

    Raises:
        ValueError: no folder, one that cannot be written to, or one with results of another task or of something else.
    """
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
