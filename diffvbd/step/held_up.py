"""Motion that pairs have held up, as seen step by step: what it is measured by, and what is said of it."""

from __future__ import annotations

import torch
from torch import Tensor

from ..model.model import Model
from ..model.warnings import HELD_UP_SEEN
from ..said import page, percent, warn
from ..scopes import looks_at
from .contact_cycles import CUT
from .met import outcomes

SEVERAL = 10  # steps in a row, made one by one, that are held up before it is said; an impact is over in fewer


def cut_share(model: Model) -> Tensor:
    """Share of the vertices that pairs held up in the Model's latest step [-], of the worst scene; a number on the
    Model's device, which is not waited for."""
    outcome = outcomes.get(model)
    if outcome is None or outcome.cut.numel() == 0 or model.num_active == 0:
        return torch.zeros((), device=model.device)
    return outcome.cut.sum(-1).amax() / model.num_active


def what_helps(model: Model) -> str:
    """What keeps pairs from holding up motion, for a warning."""
    numbered = model.contact is not None and model.contact.detections is not None
    remedy = ", or leave out its number of detections" if numbered else ""
    return f"take a smaller time_step or a larger reach of the PairBarrier{remedy}; " + page("contact.md")


def notice_step(model: Model, x: Tensor) -> None:
    """Warns (UserWarning) when pairs have held up more than CUT of the vertices in SEVERAL steps in a row, and after as
    many more.

    For steps that are made one by one: a rollout looks at its own. Values on CUDA, which would have to be waited for,
    and those of compiled, transformed or captured steps are not looked at.
    """
    if not looks_at(x) or x.is_cuda or not model.touches:
        return
    share = float(cut_share(model))
    model._derived[HELD_UP_SEEN] = seen = model._derived.get(HELD_UP_SEEN, 0) + 1 if share > CUT else 0
    if seen == 0 or seen % SEVERAL:
        return
    warn(
        f"pair_barrier: pairs held up {percent(share)} of the vertices in this step, and more than {percent(CUT)} in "
        f"each of the last {seen}; they lose velocity and momentum; " + what_helps(model)
    )
