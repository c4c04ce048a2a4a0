"""Anderson acceleration of the sweeps of a step, and its exact adjoint (docs/method.md, section 16).

With iterates x_i, what a cycle of sweeps makes of them g_i, and residuals f_i = g_i - x_i, the next iterate is

    g_k - dG gamma        (dF' M dF + eps diag(dF' M dF)) gamma = dF' M f_k        dF, dG: differences of f_i, of g_i

body by body, where the body's incremental potential does not rise over that of g_k and the differences are more than
rounding; else it is g_k. Which one was taken counts as a constant. The cycles are calls of the differentiable sweeps,
and autograd joins them with this.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn, Protocol

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..model.model import Model
from ..ops import no_second_derivative, of_inputs
from ..ops.anderson import anderson_combine
from ..ops.detect import segment_sum
from ..tuples import replaced
from .rise import rise_parts
from .sweep import sweep

REGULARIZATION = 1e-6  # of the diagonal: bounds the condition of the small system, and with it rounding in gradients
NOISE = 100  # ulps of the positions: differences of residuals that small are rounding, and so are the weights from them
COARSE_FIELDS = ("coarse_factor", "coarse_mass", "coarse_plan", "coarse_weights", "coarse_rest")


class Combining(Protocol):
    """What combines iterates of its own: the fields of MovingBodies that say which vertices belong together."""

    @property
    def order(self) -> Tensor: ...
    @property
    def ptr(self) -> Tensor: ...
    @property
    def of(self) -> Tensor: ...


class Judge(Protocol):
    """Says which bodies may take a combination."""

    @property
    def bodies(self) -> Combining: ...

    def admits(self, x: Tensor, to: Tensor) -> Tensor:
        """Whether each body may go from x to ``to`` [B, V, 3], bool [B, bodies]; a constant."""
        ...


class Swept(NamedTuple):
    """What the sweeps of a step return."""

    x: Tensor  # [B, V, 3]
    corrections: list[Tensor]  # of each operator call, as sweep() returns them
    taken: list[Tensor]  # bool [B, bodies] of each combination: whether it was
    before: Sequence[Tensor] = ()  # with combinations: where the last two cycles began


def cycles_of(model: Model, sweeps: int) -> list[int]:
    """Sweeps of each cycle of a step, of which the first has no correction before it; [sweeps] where nothing is to be
    combined: that needs two cycles with a residual, and one after them."""
    if model.coarse is None:
        return [1] * sweeps if sweeps > 2 else [sweeps]
    every, after = model.coarse.every, sweeps - 1
    cycles = [min(every, after - begun) for begun in range(0, after, every)]
    return [1, *cycles] if len(cycles) > 2 else [sweeps]


def combinations_of(model: Model, sweeps: int) -> int:
    """How often a step of so many sweeps combines iterates."""
    if model.acceleration is None:
        return 0
    return max(0, len(cycles_of(model, sweeps)) - 2 - (model.coarse is not None))


def run_sweeps(model: Model, fields: ops.SweepFields, settings: ops.SweepSettings, *, tape_policy: int,
               debug_step: int = -1) -> Swept:  # fmt: skip
    """All sweeps of a step without contact, accelerated where the Model says so; arguments as of sweep()."""

    def run(fields: ops.SweepFields, settings: ops.SweepSettings, checked: bool = True) -> tuple[Tensor, Tensor]:
        x, _, corrections = sweep(fields, model._packed_rest, model._plan, settings, tape_policy=tape_policy,
                                  debug_step=debug_step, checked=checked)  # fmt: skip
        return x, corrections

    cycles = cycles_of(model, settings.sweeps) if model.acceleration is not None else [settings.sweeps]
    if len(cycles) <= 1:
        x, corrections = run(fields, settings)
        return Swept(x, [corrections] if corrections.numel() else [], [])
    if torch.compiler.is_compiling():
        raise NotImplementedError("diffvbd: torch.compile of a step with Anderson acceleration is not supported")

    numbers = settings.numbers
    within = replaced(settings, numbers=replaced(numbers, last_relaxation=numbers.relaxation))
    x, corrections, first = fields.x_start, [], True
    if model.coarse is not None:  # a sweep alone: iterates begin after it
        alone = replaced(fields, **dict.fromkeys(COARSE_FIELDS))
        x, _ = run(alone, replaced(within, sweeps=cycles[0], coarse=()))
        cycles, first = cycles[1:], False
        if settings.coarse:
            within = replaced(within, coarse=replaced(settings.coarse, begun=1))
    parts = rise_parts(model, fields, numbers.time_step)
    assert model.acceleration is not None
    before, after, taken = [], [], []
    combine = _Combine.apply if torch.is_grad_enabled() else _Combine.forward  # whose call costs a sweep
    for n, count in enumerate(cycles):
        ends = n + 1 == len(cycles)
        now = replaced(within, sweeps=count, numbers=numbers if ends else within.numbers)
        before.append(x)
        x, done = run(replaced(fields, x_start=x), now, first)
        first = False
        corrections += [done] if done.numel() else []
        after.append(x)
        if n and not ends:
            before, after = before[-model.acceleration.window - 1 :], after[-model.acceleration.window - 1 :]
            x, kept, *_ = combine(fields.mass, parts, len(before), *before, *after)
            taken.append(kept)
    return Swept(x, corrections, taken, before[-2:])


def none_taken(model: Model, x: Tensor) -> Tensor:
    """What a step without combinations records, bool [B, 0, bodies]."""
    return x.new_empty((len(x), 0, model._moving.number), dtype=torch.bool)


def _combined(moving: Combining, mass: Tensor, states: tuple[Tensor, ...], count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The combination, and of each body's small system the inverse and the solution, as ops.anderson_combine."""
    noise = NOISE * torch.finfo(mass.dtype).eps
    if not mass.is_cuda:
        stacked = torch.stack(states).unflatten(0, (2, count))
        return anderson_combine(stacked, mass, moving.order, moving.ptr, REGULARIZATION, noise)
    return _combined_in_torch(moving, mass, states, count, noise)


def _combined_in_torch(moving: Combining, mass: Tensor, states: tuple[Tensor, ...], count: int,
                       noise: float) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """_combined() for CUDA."""
    residual, of_residuals, of_ends = _differences(states, count)
    window = count - 1
    weighted = mass[..., None, None] * of_residuals
    others = torch.cat((of_residuals, residual[..., None]), -1)
    sums = _sums(moving, (weighted[..., None] * others[..., None, :]).sum(2).flatten(-2))
    normal, right = sums.unflatten(-1, (window, window + 1)).split((window, 1), -1)
    diagonal = normal.diagonal(dim1=-2, dim2=-1)
    inverse = torch.linalg.inv_ex(normal + torch.diag_embed(diagonal * REGULARIZATION))[0]  # waits for no device
    least = noise * noise * _sums(moving, mass[..., None] * states[-1].square().sum(-1, keepdim=True))
    gamma = torch.where((diagonal > least).all(-1, keepdim=True), (inverse @ right)[..., 0], torch.nan)
    return states[-1] - _weighted(of_ends, _of_vertices(moving, gamma)), inverse, gamma


def _differences(states: tuple[Tensor, ...], count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The last residual [B, V, 3], and the differences of residuals and of ends [B, V, 3, window]."""
    ends = states[count:]
    residuals = [g - x for x, g in zip(states[:count], ends, strict=True)]
    of_residuals, of_ends = (torch.stack([b - a for a, b in zip(v[:-1], v[1:], strict=True)], -1)
                             for v in (residuals, ends))  # fmt: skip
    return residuals[-1], of_residuals, of_ends


def _sums(moving: Combining, values: Tensor) -> Tensor:
    """Values of vertices [B, V, C] summed over each body, [B, bodies, C]."""
    return segment_sum(values.contiguous(), moving.order, moving.ptr)


def _of_vertices(moving: Combining, values: Tensor) -> Tensor:
    """Values of bodies [B, bodies, ...] at their vertices, [B, V, ...]; 0 elsewhere."""
    return torch.cat((values, values.new_zeros((len(values), 1, *values.shape[2:]))), 1)[:, moving.of]


def _weighted(vectors: Tensor, weights: Tensor) -> Tensor:
    """[B, V, 3, window], [B, V, window] -> [B, V, 3]"""
    return (vectors * weights[:, :, None]).sum(-1)


class _Combine(Function):
    """The next iterate [B, V, 3]; whether each body's is the combination, bool [B, bodies]; and its system, as of
    _combined(). Arguments: masses [1 | B, V], who admits it, the number of iterates, these, and what a cycle made of
    each."""

    @staticmethod
    def forward(mass: Tensor, judge: Judge, count: int, *states: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        last, moving = states[-1], judge.bodies
        to, inverse, gamma = _combined(moving, mass, states, count)
        taken = judge.admits(last, to)
        return torch.where(_of_vertices(moving, taken)[..., None], to, last), taken, inverse, gamma

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        mass, judge, ctx.count, *states = inputs
        ctx.moving = judge.bodies
        ctx.save_for_backward(mass, *output[1:], *states)
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple:
        needs = ctx.needs_input_grad
        if grads[0] is None:
            return (None,) * len(needs)
        needs = (needs[0], *needs[3:])
        out = of_inputs(_CombineBackward.apply(grads[0], ctx.moving, ctx.count, needs, *ctx.saved_tensors), needs, 0)
        return (out[0], None, None, *out[1:])

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> NoReturn:
        raise NotImplementedError("diffvbd: torch.func.vmap of Anderson acceleration is not supported")


class _CombineBackward(Function):
    @staticmethod
    def forward(bar: Tensor, moving: Combining, count: int, needs: tuple[bool, ...], mass: Tensor, taken: Tensor,
                inverse: Tensor, gamma: Tensor, *states: Tensor) -> tuple[Tensor, ...]:  # fmt: skip
        f, of_f, of_ends = _differences(states, count)
        # a combination that was not taken may be no number
        own = torch.where(_of_vertices(moving, taken)[..., None], bar, 0)
        gamma_bar = -_sums(moving, (of_ends * own[..., None]).sum(2))
        e = torch.where(taken[..., None], (inverse @ gamma_bar[..., None])[..., 0], 0)
        e, gamma = (_of_vertices(moving, t) for t in (e, torch.where(taken[..., None], gamma, 0)))
        m = mass[..., None]
        along, solved = _weighted(of_f, e), _weighted(of_f, gamma)  # dF e, dF gamma
        of_f_bar = (f - solved)[..., None] * e[:, :, None] - along[..., None] * gamma[:, :, None]
        of_f_bar = m[..., None] * (of_f_bar - 2 * REGULARIZATION * of_f * (e * gamma)[:, :, None])
        of_g_bar = -own[..., None] * gamma[:, :, None]
        mass_bar = (along * (f - solved)).sum(-1) - REGULARIZATION * (e * gamma * of_f.square().sum(2)).sum(-1)
        # differences to their ends
        f_bars, g_bars = _undone(of_f_bar), _undone(of_g_bar)
        f_bars[-1] = f_bars[-1] + m * along
        g_bars[-1] = g_bars[-1] + bar
        bars = [-b for b in f_bars] + [a + b for a, b in zip(f_bars, g_bars, strict=True)]
        bars = [ops.sum_to(mass_bar, mass.shape), *bars]
        return tuple(b for b, need in zip(bars, needs, strict=True) if need)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> NoReturn:
        no_second_derivative()

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> NoReturn:
        raise NotImplementedError("diffvbd: batched gradients of Anderson acceleration are not supported")


def _undone(bars: Tensor) -> list[Tensor]:
    """Adjoints of differences [..., window] -> of what they are differences of, window + 1."""
    columns = bars.unbind(-1)
    return [-columns[0], *(a - b for a, b in zip(columns[:-1], columns[1:], strict=True)), columns[-1]]
