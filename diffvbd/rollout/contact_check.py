"""What a rollout says of its contact: motion that pairs have held up, friction that has not converged."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..model.system import System
from ..said import is_silent, page, percent, warn
from ..scopes import is_captured, looks_at
from ..step.arguments import Prepared, acceleration_of, collider_state
from ..step.balance import UNBALANCED_FRICTION, contact_of_step, friction_left_over, potential_of_step
from ..step.contact_cycles import CUT
from ..step.held_up import what_helps
from ..step.integrators import Solve
from ..step.predict import begin
from ..step.unsolved import unsolved

LEAST_STEPS = 10  # of a rollout that is looked at unasked: the look costs about as much as a step


def checks_contact(asked: bool | None, model: System, x: Tensor, steps: int) -> bool:
    """Whether a rollout of so many steps ends with a look at its contact. A look reads values: never in what is
    compiled, transformed or captured, and on CUDA, where it waits for the device, only where it is asked for."""
    if asked is False or not model.touches or steps == 0 or x.numel() == 0 or torch.compiler.is_compiling():
        return False
    if torch._C._functorch.peek_interpreter_stack() is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return False
    if asked:
        return not is_captured(x)
    return not x.is_cuda and looks_at(x) and steps >= LEAST_STEPS and not is_silent()


def unbalanced_friction(model: System, before: tuple[Tensor, Tensor], x: Tensor, prepared: Prepared,
                        given: dict[str, Any]) -> float:  # fmt: skip
    """What a step left unbalanced along the contact of a body, over the most that friction can bear there [-], the
    largest; 0 where it cannot be told.

    Args:
        before: State (x, v) before the step.  x: Positions after it.  given: Its other arguments, as of advance().
    """
    if model.friction is None:
        return 0.0
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        x0, v0, x = (t.detach() for t in (*before, x))
        begun = begin(model, x0, v0, prepared, given["force"], acceleration_of(given["gravity"], x0),
                      given["prescribed"]).detached()  # fmt: skip
        where = collider_state(model, x0, given["colliders"], given.get("colliders_before"))
        end = x.reshape(begun.y.shape)
        end = end if begun.origin is None else end - begun.origin
        try:
            contact = contact_of_step(model, begun, prepared, where)
            return float(friction_left_over(potential_of_step(model, end, begun, prepared, contact)).max())
        except ValueError:  # a state that is lost; the next step says why
            return 0.0


def warn_of_contact(model: System, cuts: list[Tensor], before: tuple[Tensor, Tensor], x: Tensor, prepared: Prepared,
                    given: dict[str, Any]) -> None:  # fmt: skip
    """Warns (UserWarning) of the steps of a rollout.

    cuts: cut_share() after each step. The others: of the last step, as above.
    """
    shares = torch.stack(cuts).tolist()
    cut = max(shares)
    left = unbalanced_friction(model, before, x, prepared, given)
    if cut > CUT:
        warn(
            f"contact: pairs held up {percent(cut)} of the vertices in step {shares.index(cut)}, which lost "
            f"velocity and momentum (in {sum(s > CUT for s in shares)} of {len(shares)} steps more than "
            f"{percent(CUT)}); " + what_helps(model),
        )
    if left > UNBALANCED_FRICTION and _matters(model, before, x, prepared, given):
        faster = ' subspace="coarse",' if model.coarse is None else ""
        warn(
            f"friction: {percent(left)} of what it can bear is not balanced in the last step: the sweeps have not "
            f"converged, and the motion may be far off; take more sweeps (100 are cheap in a small scene),{faster} a "
            "smaller time_step or a larger Friction(velocity=); " + page("contact.md"),
        )


def _matters(
    model: System, before: tuple[Tensor, Tensor], x: Tensor, prepared: Prepared, given: dict[str, Any]
) -> bool:
    """Whether what a step has left unbalanced would have moved a body, beside what forces do in a step."""
    found = unsolved(model, Solve(*before, prepared, given), x.detach(), {})
    return found is not None and found.error > UNBALANCED_FRICTION * found.forced
