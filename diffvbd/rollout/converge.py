"""A converged step: sweeps until the residual meets a tolerance, for which GlobalAdjoint is the right derivative."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from ..adjoint.implicit import global_sweep
from ..adjoint.potential import IncrementalPotential
from ..adjoint.routes import Adjoint, GlobalAdjoint, check_adjoint
from ..checks import check_count, check_positive, fail
from ..model.model import Model
from ..step.arguments import GRAVITY, acceleration_of, check_prescribed, check_state, prepare
from ..step.predict import begin
from ..step.step import advance, swept

ROUNDINGS = 0.25  # of block times position, below which a residual counts as zero: sweeps stall at 0.03 to 0.08, a
# corrected start in free fall at 0.15


@dataclass(frozen=True)
class Solution:
    """Result of :func:`solve`.

    Attributes:
        x, v: Positions [m] and velocities [m/s] after the step, shape [..., V, 3].
        sweeps: Executed sweeps.
        residual: Left-over force over the forces of the step [-], the largest over scenes.
        converged: Whether in every scene that meets the tolerance, or is no more than rounding leaves.
    """

    x: Tensor
    v: Tensor
    sweeps: int
    residual: float
    converged: bool


def solve(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    mu: float | Tensor | None = None,
    lam: float | Tensor | None = None,
    young: float | Tensor | None = None,
    poisson: float | Tensor | None = None,
    time_step: float,
    tolerance: float = 1e-8,
    max_sweeps: int = 10_000,
    check_every: int = 10,
    on_failure: Literal["raise", "warn"] = "raise",
    force: Tensor | None = None,
    gravity: Sequence[float] | Tensor = GRAVITY,
    prescribed: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: float | Tensor | None = None,
    parameters: dict[str, Any] | None = None,
    adjoint: Adjoint | None = None,
) -> Solution:
    """One implicit Euler step, swept until it has converged in every scene.

    The residual is |M (x - y) + h^2 dE/dx| over |M (x - y)| + |h^2 dE/dx|, 2-norms over the vertices that are not
    pinned: the part of the step's forces that is not balanced. A scene where no more is left than rounding leaves
    (in float32, or far from the origin, that can be much) counts as converged.

    Args:
        model, x, v, mu, lam, young, poisson, time_step, force, gravity, prescribed, rest_points, density, parameters:
            As in :func:`diffvbd.step`; x, v of shape [..., V, 3].
        tolerance: Residual in (0, 1) at which the sweeps end. A gradient of GlobalAdjoint is off by about that, times
            the conditioning of the step.
        max_sweeps: Number of sweeps after which to give up.
        check_every: Sweeps before the first look at the residual, which costs some tens of sweeps of a small mesh and
            on CUDA waits for the device; later looks are further apart, at most a quarter of the sweeps so far.
        on_failure: ``"raise"`` a RuntimeError, or ``"warn"`` and go on, where max_sweeps do not meet the tolerance.
        adjoint: None: GlobalAdjoint(), which sees a converged state and no sweeps. ReverseSweep() or Unrolled() run
            the same sweeps again and differentiate them.

    Returns:
        A :class:`Solution`.

    Raises:
        ValueError, TypeError: As :func:`diffvbd.step`.
        RuntimeError: Where the sweeps do not converge.

    Source: paper, eq. 1; docs/adjoints.md.
    """
    lead, adjoint = check_state(model, x, v), GlobalAdjoint() if adjoint is None else check_adjoint(adjoint)
    if model.touches:
        raise NotImplementedError("model: solve() has no contact or friction; take steps of many sweeps instead")
    if check_positive("tolerance", tolerance) >= 1:
        fail("tolerance", "a number in (0, 1)", tolerance)
    max_sweeps, check_every = check_count("max_sweeps", max_sweeps), check_count("check_every", check_every, 1)
    if on_failure not in ("raise", "warn"):
        fail("on_failure", '"raise" or "warn"', repr(on_failure))
    options: dict[str, Any] = {"mu": mu, "lam": lam, "young": young, "poisson": poisson, "time_step": time_step,
                               "rest_points": rest_points, "density": density, "parameters": parameters}  # fmt: skip
    prepared = prepare(model, lead, sweeps=0, **options)
    check_prescribed(model, prescribed, x)
    settings = prepared.settings
    loads: dict[str, Any] = {"force": force, "gravity": gravity, "prescribed": prescribed}
    begun = begin(model, x, v, prepared, force, acceleration_of(gravity, x), prescribed)

    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        frozen = begun.detached()
        # The end of a step is its last sweep, which may be relaxed less, and its correction: what was swept before them
        # is what further sweeps go on from.
        before, count, rounding = frozen.x_start, 0, None
        over = settings._replace(numbers=(*settings.numbers[:-1], settings.numbers[2]))
        end = frozen.corrected(before, model, prepared)

        def look(x: Tensor) -> tuple[float, bool]:
            nonlocal rounding
            at = IncrementalPotential(model, x, frozen.tensors(prepared), time_step)
            rounding = _rounding(at) if rounding is None else rounding
            return _residual(at, tolerance, rounding)

        residual, converged = look(end)
        while not converged and count < max_sweeps and math.isfinite(residual):
            # a look costs many sweeps: at first after check_every, later after a quarter of what there were
            some = min(max(check_every, count // 4), max_sweeps - count)
            part = prepared._replace(settings=over._replace(sweeps=some - (count == 0)))
            given = {"x": x, "v": v, **loads}
            before = swept(model, frozen._replace(x_start=before), part, given)
            last = prepared._replace(settings=settings._replace(sweeps=1))
            end = frozen.corrected(swept(model, frozen._replace(x_start=before), last, given), model, prepared)
            count += some
            residual, converged = look(end)
    if not converged:
        text = (
            f"solve: expected a residual of at most {tolerance:g}, got {residual:.3g} after {count} sweeps; take more "
            "(max_sweeps), a smaller time step, or with the exact block a relaxation between 1.5 and 1.7"
        )
        if on_failure == "raise":
            raise RuntimeError(text)
        warnings.warn(text, RuntimeWarning, stacklevel=2)

    if isinstance(adjoint, GlobalAdjoint):
        # the converged state is the end of no further sweeps; where pinned it is the predictor, with its graph
        begun = begun._replace(x_start=torch.where(model._pinned[:, None], begun.x_start, end))
        x_end, v_end = begun.finish(
            global_sweep(model, begun.tensors(prepared), settings, adjoint), model, prepared, corrects=False
        )
    else:
        again = prepare(model, lead, sweeps=count, adjoint=adjoint, **options)
        x_end, v_end = advance(model, x, v, again, adjoint=adjoint, **loads)
    return Solution(x_end.reshape(x.shape), v_end.reshape(x.shape), count, residual, converged)


def _rounding(at: IncrementalPotential) -> Tensor:
    """A norm of the gradient that rounding alone may leave, of each scene: a block times what rounds a position."""
    stiffness = at.free * at.diagonal().diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    return ROUNDINGS * torch.finfo(at.x.dtype).eps * at.x.abs().amax((-2, -1)) * _norm(stiffness)


def _residual(at: IncrementalPotential, tolerance: float, rounding: Tensor) -> tuple[float, bool]:
    """The largest residual over scenes, and whether all of them have converged."""
    if not at.x.numel():
        return 0.0, True
    inertia, forces = at.free * at.inertia(), at.free * at.forces()
    left, scale = _norm(inertia + forces), _norm(inertia) + _norm(forces)
    ratio = left / torch.where(scale > 0, scale, 1)
    done = (ratio <= tolerance) | ((left <= rounding) & torch.isfinite(rounding))
    return float(torch.nan_to_num(ratio, nan=torch.inf).max()), bool(done.all())


def _norm(a: Tensor) -> Tensor:
    return a.square().sum((-2, -1)).sqrt()
