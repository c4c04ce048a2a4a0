"""A loss and its gradient as one CUDA graph."""

from collections.abc import Callable

import torch
from torch import Tensor


def captured(run: Callable[[], Tensor], warm: int = 2) -> Callable[[], Tensor]:
    """`run` as a CUDA graph: the same work on the same memory, results and gradients included. The optimiser stays
    outside: its few launches cost nothing beside a rollout, and so any optimiser will do.

    A graph cannot make its lists of pairs longer: a step with more pairs than when it was captured returns NaN. Then
    `run` works once outside of it, where lists grow or the step says what is wrong, and is captured anew.
    """
    graph, result = _graph(run, warm)

    def replay() -> Tensor:
        nonlocal graph, result
        graph.replay()
        if not bool(torch.isfinite(result).all()):
            del graph  # its memory goes to the next
            graph, result = _graph(run, 1)
            graph.replay()
        return result

    return replay


def _graph(run: Callable[[], Tensor], warm: int) -> tuple[torch.cuda.CUDAGraph, Tensor]:
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(warm):  # libraries load, autograd makes its buffers
            run()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = run()
    return graph, result
