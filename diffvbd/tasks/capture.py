"""A loss and its gradient as one CUDA graph."""

from collections.abc import Callable

import torch
from torch import Tensor


def captured(run: Callable[[], Tensor], warm: int = 2) -> Callable[[], Tensor]:
    """`run` as a CUDA graph: the same work on the same memory, results and gradients included. The optimiser stays
    outside: its few launches cost nothing beside a rollout, and so any optimiser will do."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(warm):  # libraries load, autograd makes its buffers
            run()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = run()

    def replay() -> Tensor:
        graph.replay()
        return result

    return replay
