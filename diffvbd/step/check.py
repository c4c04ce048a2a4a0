"""What a step does where debug_checks() is on."""

from __future__ import annotations

import torch

from .. import ops
from ..adjoint.sweep import sweep
from ..model.system import System
from ..tuples import replaced


def check_on_cpu(model: System, fields: ops.SweepFields, settings: ops.SweepSettings, index: int) -> None:
    """The CPU repeats a step and names what is wrong with it."""
    twin = model._on_cpu()
    settings = replaced(settings, sizes=twin._sizes, launch=())
    with torch.no_grad():
        here = ops.SweepFields(*(t if t is None else t.detach().cpu() for t in fields))  # pyright: ignore
        if settings.coarse:
            plan = twin._coarse_plan  # whose positions are those of the CPU
            settings = replaced(settings, coarse=replaced(plan.sizes, begun=settings.coarse.begun))
            here = replaced(here, coarse_plan=plan.plan, coarse_weights=plan.weights)
        sweep(here, twin._packed_rest, twin._plan, settings, tape_policy=ops.NO_TAPE, debug_step=index)
