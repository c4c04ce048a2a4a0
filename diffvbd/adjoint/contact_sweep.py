"""The sweeps of a step with contact as autograd functions: as in sweep.py, and with pairs, bounds and lagged terms."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..ops import contact_sweep as ops_contact_sweep
from ..ops import detect as ops_contact
from ..ops import distinct, no_second_derivative, of_inputs
from .sweep import SweepTensors, backward_memory


class Pairs(NamedTuple):
    """Index data of a detection: which pairs there are; not differentiable. Shapes: detection.detect."""

    pairs: Tensor
    constants: Tensor
    ptr: Tensor
    entry: Tensor


class ContactTensors(NamedTuple):
    """What the sweeps with contact differentiate besides SweepTensors, in the order of csrc/bind/schema.cpp."""

    bounds: Tensor  # [B, V, 4]  center and radius [m]
    collider: Tensor  # [B, Vc, 3] during the sweeps [m]
    collider_prev: Tensor  # [B, Vc, 3] at the start of the step [m]
    kappa: Tensor  # [1 | B] [N/m]
    lag: Tensor  # [pairs, 9] of the lagged pairs, or empty
    floor_lag: Tensor  # [B, V, planes, 4], or empty


_SWEEP, _CONTACT = 8, 6  # differentiable inputs: SweepTensors without the origin, ContactTensors


def no_transforms() -> NoReturn:
    raise NotImplementedError("diffvbd: torch.func transforms of a step with contact are not supported")


def _flat(bounds: Tensor, collider: Tensor, collider_prev: Tensor, kappa: Tensor, listed: Pairs, lag: Tensor,
          lagged: Pairs, floor_lag: Tensor) -> tuple[Tensor, ...]:  # fmt: skip
    """In the order of the operators."""
    lists = (lagged.pairs, lagged.ptr, lagged.entry)
    return (bounds, collider, collider_prev, kappa, *listed, lag, *lists, floor_lag)


class _ContactSweep(Function):
    """K sweeps with contact and, as its backward, the same sweeps transposed in reverse order."""

    @staticmethod
    def forward(x_start, x_prev, y, mu, lam, mass, rest, energy_data, bounds, collider, collider_prev, kappa, lag,
                floor_lag, origin, packed_rest, plan, listed, lagged, friction_eps, settings, tape_policy, debug_step,
                checked):  # fmt: skip
        if rest is not None:
            packed_rest = ops.pack_rest(rest, plan, settings.sizes)
        return ops_contact_sweep.sweep((x_start, x_prev, y, mu, lam, mass, packed_rest, energy_data, origin),
                                 _flat(bounds, collider, collider_prev, kappa, listed, lag, lagged, floor_lag),
                                 friction_eps, plan, settings, tape_policy, debug_step, checked)  # fmt: skip

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor, Tensor]) -> None:
        *tensors, packed_rest, plan, listed, lagged, friction_eps, settings, tape_policy, _, _ = inputs
        ctx.save_for_backward(*tensors, packed_rest, plan, *output[:2])
        ctx.rest = (listed, lagged, friction_eps, settings, tape_policy)
        ctx.mark_non_differentiable(output[1], output[2])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        if grads[0] is None:
            return (None,) * (_SWEEP + _CONTACT + 10)
        needs = ctx.needs_input_grad[: _SWEEP + _CONTACT]
        out = _ContactBackward.apply(grads[0], *ctx.saved_tensors, *ctx.rest, needs)
        return of_inputs(out, needs, 10)


class _ContactBackward(Function):
    @staticmethod
    def forward(x_bar, x_start, x_prev, y, mu, lam, mass, rest, energy_data, bounds, collider, collider_prev, kappa,
                lag, floor_lag, origin, packed_rest, plan, x, tape, listed, lagged, friction_eps, settings, tape_policy,
                needs):  # fmt: skip
        with backward_memory(x, settings, tape_policy):
            if rest is not None:
                packed_rest = ops.pack_rest(rest, plan, settings.sizes)
            inputs = (x_prev, y, mu, lam, mass, packed_rest, energy_data, origin)
            contact = _flat(bounds, collider, collider_prev, kappa, listed, lag, lagged, floor_lag)
            if tape_policy == ops.NO_TAPE:
                tape_policy = ops.FULL_TAPE
                x, tape, _ = ops_contact_sweep.sweep((x_start, *inputs), contact, friction_eps, plan, settings,
                                                     tape_policy, -1, False)  # fmt: skip
            wants = (needs[3] or needs[4], needs[5], needs[6], needs[7])
            bars = ops_contact_sweep.sweep_backward(x_bar.contiguous(), (x, *inputs), contact, friction_eps, tape, plan,
                                              settings, tape_policy, wants)  # fmt: skip
        given: tuple[Any, ...] = (x_start, x_prev, y, mu, lam, mass, rest, energy_data, bounds, collider, collider_prev,
                                  kappa, lag, floor_lag)  # fmt: skip
        return tuple(ops.sum_to(bar, t.shape) for bar, t, need in zip(bars, given, needs, strict=True) if need)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.count = len(inputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> NoReturn:
        no_second_derivative()


def contact_sweep(tensors: SweepTensors, contact: ContactTensors, listed: Pairs, lagged: Pairs, friction_eps: float,
                  packed_rest: Tensor, plan: Tensor, settings: ops.SweepSettings, *, tape_policy: int,
                  debug_step: int = -1) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions after the sweeps [B, V, 3], and where a bound has held back an update, uint8 [B, V].

    Args:
        tensors, packed_rest, plan, settings, tape_policy, debug_step: As adjoint.sweep.sweep.
        contact: Differentiable, see ContactTensors.  listed, lagged: Pairs that repel, and those of ``lag``.
        friction_eps: Motion within the step below which friction is smoothed [m].
    """
    *swept, origin = tensors
    flat = distinct(*swept, *contact, origin)
    x, _, cut = _ContactSweep.apply(*flat, packed_rest, plan, listed, lagged, friction_eps, settings, tape_policy,
                                    debug_step, True)  # fmt: skip
    return x, cut


class _Lag(Function):
    """Normal force, activity, normal and weights of pairs at the start of a step [pairs, 9]."""

    @staticmethod
    def forward(x: Tensor, collider: Tensor, kappa: Tensor, origin: Tensor, listed: Pairs) -> Tensor:
        return ops_contact_sweep.lag(x, origin, collider, kappa, *listed)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        x, collider, kappa, origin, ctx.listed = inputs
        ctx.save_for_backward(x, origin, collider, kappa)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        x, origin, collider, kappa = ctx.saved_tensors
        bars = ops_contact_sweep.lag_backward(grads[0].contiguous(), x, origin, collider, kappa, *ctx.listed)
        given = (x, collider, kappa)
        return (*(ops.sum_to(b, t.shape) for b, t in zip(bars, given, strict=True)), None, None)


class _OfScene(Function):
    """A value of each scene [B] for each pair of a list [pairs]."""

    @staticmethod
    def forward(value: Tensor, listed: Pairs) -> Tensor:
        return value[listed.pairs[:, 5].clamp(min=0).to(torch.int64)]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.scenes, ctx.listed = inputs[0].shape[0], inputs[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        ptr = ctx.listed.ptr  # pairs are sorted by scene, with four entries each
        first = (ptr[:: (ptr.shape[0] - 1) // ctx.scenes] // 4).contiguous()
        order = torch.arange(grads[0].shape[0], dtype=torch.int32, device=ptr.device)
        return ops_contact.segment_sum(grads[0][None, :, None].contiguous(), order, first)[0, :, 0], None


def of_scene(value: Tensor, listed: Pairs) -> Tensor:
    """value [B], one for each scene, for each pair [pairs]; its gradient is summed in a fixed order."""
    return _OfScene.apply(value, listed)


def pair_lag(x: Tensor, collider: Tensor, kappa: Tensor, origin: Tensor, listed: Pairs) -> Tensor:
    """[pairs, 9]: normal force [N], 1 where closer than dhat, normal (3), weights (4); differentiable in three.

    Args:
        x: [B, V, 3] [m].  collider: [B, Vc, 3] [m].  kappa: [1 | B] [N/m].  origin: [B, V, 3] or empty.
    """
    return _Lag.apply(x.contiguous(), collider.contiguous(), kappa.contiguous(), origin, listed)


ops.ready_signature(_ContactSweep, _ContactBackward, _Lag, _OfScene)
