"""Motion that pairs have held up: how it is measured, and what helps."""

from __future__ import annotations

import torch
from torch import Tensor

from ..model.system import System
from ..said import page
from .met import outcomes


def cut_share(model: System) -> Tensor:
    """Share of the vertices that pairs held up in the Model's latest step [-], of the worst scene; a number on the
    Model's device, which is not waited for."""
    outcome = outcomes.get(model.model)
    if outcome is None or outcome.cut.numel() == 0 or model.num_active == 0:
        return torch.zeros((), device=model.device)
    return outcome.cut.sum(-1).amax() / model.num_active


def what_helps(model: System) -> str:
    """What keeps pairs from holding up motion, for a warning."""
    numbered = model.contact is not None and model.contact.detections is not None
    remedy = ", or leave out its number of detections" if numbered else ""
    return f"take a smaller time_step or a larger reach of the PairBarrier{remedy}; " + page("contact.md")
