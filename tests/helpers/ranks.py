"""Several processes as the ranks of one group, on the CPU."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp


def on_ranks(work: Callable[..., Any], ranks: int, folder: Path, *arguments: Any) -> list[Any]:
    """What work(*arguments) returns on each of several ranks of gloo, which meet in a file of the folder."""
    folder.mkdir()
    mp.spawn(_rank, args=(work, ranks, folder, arguments), nprocs=ranks)  # pyright: ignore[reportPrivateImportUsage]
    return [torch.load(folder / f"{rank}.pt") for rank in range(ranks)]


def _rank(rank: int, work: Callable[..., Any], ranks: int, folder: Path, arguments: tuple[Any, ...]) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=ranks)
    torch.save(work(*arguments), folder / f"{rank}.pt")
    dist.destroy_process_group()
