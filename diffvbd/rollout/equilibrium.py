"""Rest states under loads, differentiable by the implicit function theorem.

At a state x with dU/dx = 0 at the free vertices, one linear solve gives the adjoint of everything that U depends on, as
in :mod:`diffvbd.adjoint.implicit`.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from .._common.checks import check_bool, check_count, check_kind, check_positive, fail, is_word
from .._common.context import refuse_refinement, refuse_transforms
from .._common.messages import page, warn
from ..adjoint.implicit import solve_adjoint
from ..adjoint.routes import GlobalAdjoint
from ..adjoint.statics import StaticPotential, Statics, newton_operators
from ..model.inputs import parameter_of
from ..model.model import Model
from ..model.solver import VBD
from ..model.system import System
from ..ops import is_batched, no_second_derivative, of_inputs
from ..step.arguments import (
    VISCOSITIES,
    acceleration_of,
    broadcastable,
    check_prescribed,
    check_state,
    collider_state,
    given_of,
    prepare,
    refuse_non_finite,
)
from ..step.couplings import row_of
from ..step.predict import energy_data
from ..step.warnings import system_for
from .newton import Limits, Rest, find_rest

ROUNDINGS = 4.0  # of a product with the Hessian, that the backward's residual may keep
NET = 1e-9  # of the sizes of a body's loads, below which their sum counts as zero
SINGULAR = 1e-14  # determinant of a vertex's block over its trace cubed


@dataclass(frozen=True)
class Equilibrium:
    """Result of :func:`diffvbd.equilibrium`.

    Attributes:
        x: Positions at rest [m], shape [..., V, 3].
        residual: Force left over at free vertices over the internal forces and loads of all [-], the largest over
            scenes, in float64 before x is rounded to the Model's dtype.
        iterations: Of Newton's method, of all increments of the loads.
        converged: Whether in every scene that meets the tolerance, or is no more than rounding leaves.
    """

    x: Tensor
    residual: float
    iterations: int
    converged: bool

    def __repr__(self) -> str:
        return (f"Equilibrium(x of shape {list(self.x.shape)}, residual={self.residual:.3g}, "
                f"iterations={self.iterations}, converged={self.converged})")  # fmt: skip


def equilibrium(
    model: Model,
    x: Tensor,
    solver: VBD,
    *,
    tolerance: float = 1e-8,
    max_iterations: int = 1000,
    on_failure: Literal["raise", "warn"] = "raise",
    adjoint: GlobalAdjoint | None = None,
    progress: bool = False,
    **inputs: Any,
) -> Equilibrium:
    """State of rest near x under loads, pins, floors, anchors, couplings and contact, by Newton's method.

    What is found is a local minimum of the potential energy, without inertia, and from x downhill: where there are
    several, as after buckling, x decides, and an x that is in balance is returned, be it stable or not. Friction and
    damping have no part in it: a body that only friction would hold slides on. The gradient is that of the equation
    dU/dx = 0 at its solution; one linear solve gives it for all inputs. It raises where a body may turn or slide.

    Args:
        model: The Model.
        x: Where the search starts [m], shape [..., V, 3]; with floors and pairs above and without contact. Pinned
            vertices stay there where ``prescribed`` is not given, and only so x has a gradient.
        solver: Of it ``subspace`` alone plays a part: ``"coarse"`` preconditions the linear solves, which long, stiff
            and large bodies want.
        tolerance: Residual in (0, 1) at which the iterations end.
        max_iterations: Number of iterations after which to give up.
        on_failure: ``"raise"`` a RuntimeError, or ``"warn"`` and go on, where the tolerance is not met.
        adjoint: Tolerance, max_iterations, on_failure and report of the backward's linear solve; its matrix is stored.
        progress: Print the residual at each iteration, by the logger "diffvbd".
        inputs: As in :func:`diffvbd.step`. ``prescribed`` moves the pinned vertices from x, in increments if need be.
            Those of friction and of contact damping are checked and have no gradient; ``viscosity``,
            ``volume_viscosity``, ``drag`` and ``colliders_before`` raise.

    Returns:
        A :class:`diffvbd.results.Equilibrium`.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came.
        RuntimeError: Where the iterations do not converge; where nothing holds a body against its loads, so that it has
            no equilibrium; in the backward, where the linear solve fails, as on a body that may slide freely.

    Source: Nocedal and Wright, Numerical Optimization, section 7.1; docs/statics.md, docs/method.md.
    """
    refuse_refinement("dv.equilibrium")
    refuse_transforms("dv.equilibrium, which looks at values")
    lead, system = check_state(model, x, x), system_for(model, solver)
    if check_positive("tolerance", tolerance) >= 1:
        fail("tolerance", "a number in (0, 1)", tolerance)
    if model.rigid_bodies is not None:
        raise NotImplementedError("model: expected no rigid bodies in an equilibrium, got some: let them come to rest "
                                  "in a rollout with drag=")  # fmt: skip
    limits = Limits(tolerance, check_count("max_iterations", max_iterations, 1), progress)
    if not is_word(on_failure, "raise", "warn"):
        fail("on_failure", '"raise" or "warn"', repr(on_failure))
    adjoint = GlobalAdjoint() if adjoint is None else adjoint
    check_kind("adjoint", adjoint, GlobalAdjoint)
    check_bool("progress", progress)
    held, given = _statics(system, x, lead, inputs)
    start = x.detach().reshape(held.shape).double().contiguous()  # may be expanded over scenes
    end, outcome = _Rest.apply(held, *given, start, system, limits, adjoint)
    residual = float(outcome.residual.max()) if len(held) else 0.0
    converged = bool(outcome.converged.all())
    if not converged:
        text = _failure(outcome, tolerance)
        if on_failure == "raise":
            raise RuntimeError(text)
        warn(text, RuntimeWarning)
    elif bool(outcome.turned.any()):
        warn(f"equilibrium: tets of scene {int(outcome.turned.nonzero()[0])} ended inside out: load less, or take a "
             "law with a logarithm of J, see dv.law; " + page("statics.md"))  # fmt: skip
    return Equilibrium(end.to(x.dtype).reshape(x.shape), residual, outcome.iterations, converged)


def _statics(model: System, x: Tensor, lead: tuple[int, ...], inputs: dict[str, Any]) -> tuple[Tensor, Statics]:
    """Where pinned vertices are held [B, V, 3] [m], and what the potential depends on; differentiable."""
    sorted_inputs = given_of(model, inputs)
    material, parameters, loads = sorted_inputs
    for name in ("colliders_before", *VISCOSITIES, "drag"):
        if {**loads, **material}[name] is not None:
            fail(name, "none: at rest nothing has moved", "a value")
    for name in ("prescribed", "colliders"):
        if isinstance(loads[name], tuple):
            fail(name, "a tensor", "a tuple, which SDIRK2 takes")
    gravity = acceleration_of(loads["gravity"], x)
    check_prescribed(model, loads["prescribed"], x)
    refuse_non_finite(model, {"x": x, **loads, "gravity": gravity, **material, **parameters})
    prepared = prepare(model, lead, sorted_inputs, time_step=1.0, sweeps=0)

    flat, pinned = (math.prod(lead), *x.shape[-2:]), model._pinned[:, None]
    held = x if loads["prescribed"] is None else broadcastable("prescribed", loads["prescribed"], x)
    held = torch.where(pinned, ops.broadcast(held, x.shape), x.detach()).reshape(flat)
    load = prepared.mass[..., None] * ops.broadcast(gravity, x.shape).reshape(flat)
    if loads["force"] is not None:
        load = load + ops.broadcast(broadcastable("force", loads["force"], x), x.shape).reshape(flat)
    load = torch.where(pinned, torch.zeros_like(load), load)

    if model.floor is not None:  # nothing moves
        none = prepared.mass.new_zeros((1,))
        prepared = prepared._replace(parameters={**prepared.parameters, "floor_damping": none})
    colliders = collider_state(model, x, loads["colliders"], None)
    kappa = parameter_of(model, prepared.parameters, "pair_kappa")
    given = Statics(load, prepared.mu, prepared.lam, model.rest_scalars if prepared.rest is None else prepared.rest,
                    energy_data(model, prepared, None), x.new_zeros((flat[0], 0, 3)) if colliders is None else
                    colliders[1], x.new_zeros((1,)) if kappa is None else kappa,
                    row_of(model, prepared.parameters, flat[0]))  # fmt: skip
    return held.double(), Statics(*(t.double() for t in given))


class _Rest(Function):
    @staticmethod
    def forward(ctx: Any, held: Tensor, *args: Any) -> tuple[Tensor, Rest]:
        *tensors, start, model, limits, adjoint = args
        with torch.inference_mode(False), torch.no_grad(), torch.autocast(start.device.type, enabled=False):
            # clones: what was made in inference mode cannot be differentiated, as the barrier of pairs is
            held, start, *tensors = (t.clone() if t.is_inference() else t for t in (held, start, *tensors))
            given = Statics(*tensors)
            _check_start(model, start, given)
            rest = find_rest(model, start, held, given, limits)
        ctx.save_for_backward(rest.x, *tensors)
        ctx.model, ctx.adjoint = model, adjoint
        return rest.x, rest

    @staticmethod
    def backward(ctx: Any, x_bar: Tensor, _: Any) -> tuple:
        if is_batched(x_bar):
            raise NotImplementedError("equilibrium: expected gradients one at a time, got batched ones "
                                      "(is_grads_batched)")  # fmt: skip
        needs = ctx.needs_input_grad[: 1 + len(Statics._fields)]
        return of_inputs(_RestBackward.apply(x_bar, *ctx.saved_tensors, ctx.model, ctx.adjoint, needs), needs, 4)


class _RestBackward(Function):
    @staticmethod
    def forward(ctx: Any, x_bar: Tensor, x: Tensor, *args: Any) -> tuple[Tensor, ...]:
        *tensors, model, adjoint, needs = args
        with torch.autocast(x.device.type, enabled=False):
            at = StaticPotential(model, x, Statics(*tensors))
            try:
                w = solve_adjoint(at, torch.where(at.free > 0, x_bar, 0), adjoint, newton_operators(at), "equilibrium",
                                  ROUNDINGS)  # fmt: skip
            except RuntimeError as error:
                raise RuntimeError(f"{error}. Where a body may slide or turn freely there is no derivative: hold it, "
                                   "best by a weak dv.Anchor") from None  # fmt: skip
            held = torch.where(at.free > 0, 0, x_bar - at.product(w))
            bars = [held, *(ops.sum_to(bar, tensor.shape) for bar, tensor in zip(at.depends(w), tensors, strict=True))]
        return tuple(bar for bar, need in zip(bars, needs, strict=True) if need)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        no_second_derivative()


# --- what has no equilibrium, and what was not found ------------------------------------------------------------------


def _check_start(model: System, x: Tensor, given: Statics) -> None:
    """Raises where x is below a floor, for vertices without stiffness, and for bodies that nothing holds."""
    at = StaticPotential(model, x, given)
    if model.floor is not None:
        below = (model.floor.gaps(x, given.data[:, : model.floor.count()], None)[0] <= 0).any(-1) & (at.free[:, 0] > 0)
        if bool(below.any()):
            fail("x", "every unpinned vertex above the floor", f"one at or below it, [scene, vertex] "
                 f"{below.nonzero()[0].tolist()}")  # fmt: skip
    if not bool(torch.isfinite(at.coupling_terms).all()):
        fail("x", "cavities of positive volume, for their gas", "one without")
    blocks = at.diagonal()
    size = blocks.diagonal(dim1=-2, dim2=-1).sum(-1)
    loose = (at.free[:, 0] > 0) & (torch.linalg.det(blocks) <= SINGULAR * size**3)
    if bool(loose.any()):
        fail("young, mu or energies", "stiffness at every free vertex, by its tets, an Anchor or springs",
             f"none at one, [scene, vertex] {loose.nonzero()[0].tolist()}")  # fmt: skip
    if model.floor is not None or model.contact is not None:
        return  # which may come to hold a body
    labels, holds, blocks = model.body, model._pinned, at.vertex_blocks()
    if model.couplings:
        tied = torch.cat([energy.joins()[1] for energy in model.couplings])
        labels, holds = model.joined.to(labels.device), holds.index_fill(0, tied.to(labels.device), True)
    holds = holds.expand(len(x), -1) if blocks is None else holds | (blocks != 0).any(-1).any(-1)
    sums = x.new_zeros((len(x), int(labels.max()) + 1, 4)) if labels.numel() else x.new_zeros((len(x), 0, 4))
    size = given.load.norm(dim=-1, keepdim=True)
    sums = sums.index_add(1, labels, torch.cat([given.load, size], -1))
    held = sums.new_zeros(sums.shape[:2]).index_add(1, labels, holds.to(x)) > 0
    net = sums[..., :3].norm(dim=-1)
    falls = ~held & (net > NET * sums[..., 3])
    if bool(falls.any()):
        scene, body = falls.nonzero()[0].tolist()
        raise RuntimeError(f"equilibrium: expected bodies that are held (pinned, Anchor, Springs, floor, PairBarrier), "
                           f"got body {body} of scene {scene}, which nothing holds against a net load of "
                           f"{float(net[scene, body]):.3g} N: it has no equilibrium")  # fmt: skip


def _failure(rest: Rest, tolerance: float) -> str:
    if bool(rest.unbounded.any()):
        return (f"equilibrium: expected bodies that are held against their loads, got one that went far away in scene "
                f"{int(rest.unbounded.nonzero()[0])}: the potential is unbounded and has no equilibrium")  # fmt: skip
    scene = int((~rest.converged).nonzero()[0])
    if not math.isfinite(float(rest.residual[scene])):
        return f"equilibrium: expected pins that move without closing a gap, got ones that close one in scene {scene}"
    return (f"equilibrium: expected a residual of at most {tolerance:g}, got {float(rest.residual[scene]):.3g} in "
            f"scene {scene} after {rest.iterations} iterations; start nearer, load in increments, or take more "
            f"(max_iterations); " + page("statics.md"))  # fmt: skip
