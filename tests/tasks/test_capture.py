"""Claim: a captured evaluation that a graph cannot finish is made anew outside of it, and captured again."""

import pytest
import torch
from torch import Tensor

from diffvbd.tasks.runner import captured


@pytest.mark.cuda
def test_what_does_not_fit_a_graph_is_captured_again() -> None:
    x, room, calls = torch.tensor(0.5, device="cuda"), 1.0, []

    def run() -> Tensor:
        """x squared, as far as there is room; outside of a graph there is always."""
        nonlocal room
        calls.append(torch.cuda.is_current_stream_capturing())
        if not calls[-1] and float(x) > room:
            room = 2 * float(x)
        return torch.where(x <= room, x * x, torch.nan)

    replay = captured(run)
    for value, number in ((0.5, 3), (0.8, 3), (5.0, 5), (7.0, 5), (0.5, 5)):
        x.fill_(value)
        assert float(replay()) == pytest.approx(value * value)
        assert len(calls) == number  # warmed up twice and captured; later once and captured
    assert calls == [False, False, True, False, True]


@pytest.mark.cuda
def test_what_is_lost_outside_of_a_graph_is_returned() -> None:
    x = torch.tensor(1.0, device="cuda")
    replay = captured(lambda: x.log())
    assert float(replay()) == 0.0
    x.fill_(-1.0)
    assert torch.isnan(replay())
