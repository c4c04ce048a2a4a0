"""A run over the ranks that torchrun has started: all work alike, the first one alone keeps files."""

import contextlib
import gc
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist

from diffvbd.tasks.folder import STATE
from diffvbd.tasks.problem import Settings


def is_first() -> bool:
    """Whether this process keeps files: alone, or the first of its group."""
    return not dist.is_initialized() or dist.get_rank() == 0


@contextlib.contextmanager
def joined(device: str, splits: bool) -> Iterator[None]:
    """Inside, the processes that torchrun has started are one group; a process on its own stays so.

    Raises:
        ValueError: several processes for a task that does not split; a CUDA device by its number, where each rank takes
            its own.
    """
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
