"""Warnings of steps: of a solver, units, thin tets and too few sweeps before they begin, and of states that are lost,
bent or inside out (docs/numerics.md)."""

from __future__ import annotations

import contextlib
import math
from contextvars import ContextVar
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._common.checks import input_name
from .._common.constants import ELASTIC
from .._common.context import inside, is_silent, looks_at, unheard
from .._common.messages import page, warn
from ..model.inputs import parameter_of
from ..model.material import inside_out, thinness
from ..model.model import Model
from ..model.solver import VBD, Integrator
from ..model.system import System, system_of
from ..ops import broadcast
from .arguments import Prepared
from .stability import MOST_SWEEPS, measured

INCOMPRESSIBLE = 60.0  # lam / mu (nu = 0.492) above which over-relaxed rollouts grew; 49 did not
STABLE_RELAXATION = 1.7  # largest omega that never grew in the rollouts of docs/numerics.md
HEAVY_REGULARIZATION = 0.1  # of the lightest vertex
THIN = 10.0  # longest edge over shortest height; those of a cube have 2.4
TOO_STIFF = 0.55  # times aspect^2: so much too stiff were sheets of one layer, from 3.4 to 24
MOST_BODIES = 8  # whose bending is looked at
BENT = 0.01  # of the height of a tet, by which a body is no longer an affine image of its rest shape
STIFF_JOINT = 0.25  # stiffness of springs between two rigid bodies over m / h^2, from which on 20 sweeps lose momentum
SOFTEST = 10.0  # [Pa] Young's modulus; soft gels have 100 Pa or more
LONGEST_STEP = 1.0  # [s]
ALIKE = 8  # moduli that differ by less than 2^(1/8) are measured once
GROWTH = "growth at rest"  # of a Model's _derived: what was measured, by the arguments

_proven: ContextVar[bool] = ContextVar("diffvbd.proven", default=False)


def system_for(model: Model, solver: VBD) -> System:
    """The System of a call, with the warnings that it deserves."""
    system = system_of(model, solver)
    if system.relaxation > 1 or system.regularization:
        warn_of_solver(system)
    return system


def warn_of_solver(model: System) -> None:
    """Warns (UserWarning) of safeguards and relaxations outside the range in which they make sense."""
    if model.relaxation > STABLE_RELAXATION:
        warn(f"relaxation: rollouts were seen to gain energy above {STABLE_RELAXATION}, got {model.relaxation:g}")
    if model.relaxation > 1 and model.friction is not None:
        warn(
            f"relaxation: {model.relaxation:g} with Friction: above 1 gradients were seen to grow by ten decades while "
            "vertices stick; take relaxation=1 and more sweeps where gradients matter"
        )
    if model.block == "paper" and model.relaxation > 1 and model.saturation is None:
        warn('relaxation: block="paper" with relaxation > 1 and no saturation may diverge')
    if not model.regularization or not looks_at(model._mass):
        return
    active = model._mass[~model._pinned]
    if active.numel() and model.regularization > HEAVY_REGULARIZATION * float(active.min()):
        warn(
            f"regularization: {model.regularization:g} kg is {model.regularization / float(active.min()):.2g} of the "
            "lightest vertex; the sweeps converge that much more slowly"
        )


# --- sweeps that are too few, before a step ---------------------------------------------------------------------------


def proven() -> contextlib.AbstractContextManager[None]:
    """Inside, it is not doubted that vibrations stay small: a pilot run with these settings has ended well."""
    return inside(_proven, True)


def warn_of_sweeps(model: System, prepared: Prepared, integrator: Integrator) -> None:
    """Warns (UserWarning) where the sweeps of steps are too few for a mesh and its material. On CUDA, where moduli
    would be waited for, they are not looked at outside debug_checks()."""
    if not (looks_at(prepared.mu) and looks_at(prepared.lam)) or is_silent():
        return
    h, sweeps = prepared.time_step_and_sweeps
    if model.rigid_bodies is not None and model.couplings:
        warn_of_joints(model, prepared, h)
    if not sweeps or not model.num_tets or not model.num_active:
        return
    warn_of_units(model, prepared.mu, prepared.lam, h)
    warn_of_thin_tets(model, prepared.mu, prepared.lam, h, sweeps)
    if warn_of_over_relaxation(model, prepared.mu, prepared.lam) or _proven.get():
        return
    if message := growth_message(model, prepared, integrator):
        warn(message)


def warn_of_joints(model: System, prepared: Prepared, h: float) -> None:
    """Warns of springs and tendons between two rigid bodies that are stiff for a step: each sweep moves either body as
    if the other one stayed, so that both are held back."""
    assert model.rigid_bodies is not None
    body, worst = model.body.cpu(), 0.0
    mass = torch.zeros(model.mesh.num_bodies, dtype=torch.float64).index_add(0, body, model._mass.double().cpu())
    for energy in model.couplings:
        if "stiffness" not in energy.parameters:
            continue
        ends = body[energy.joins()[0]]
        rigid = torch.isin(ends, torch.tensor(model.rigid_bodies.numbers)).all(1) & (ends[:, 0] != ends[:, 1])
        stiffness = parameter_of(model, prepared.parameters, input_name(energy, "stiffness"))
        if bool(rigid.any()) and stiffness is not None and looks_at(stiffness):
            least = float(mass[ends[rigid]].min())
            worst = max(worst, h * h * float(stiffness.detach().max()) / least)
    if worst > STIFF_JOINT:
        warn(f"springs: between rigid bodies a stiffness of {worst:.2g} m / h^2, with m the lighter mass, holds both "
             f"back like a place, whatever the gap; take at most {STIFF_JOINT:g} m / h^2 and 20 sweeps, or one body; "
             + page("rigid-bodies.md"))  # fmt: skip


def growth_message(model: System, prepared: Prepared, integrator: Integrator) -> str:
    """Message about steps that amplify vibrations, or ""; measured once for such arguments. Moduli are read."""
    h, sweeps = prepared.time_step_and_sweeps
    if not (0 < sweeps <= MOST_SWEEPS and model.num_tets and model.num_active):
        return ""
    if not model.energy_mask & ELASTIC:
        return ""
    mu, lam = prepared.mu.detach().cpu(), prepared.lam.detach().cpu()
    if not (mu.numel() and lam.numel()):
        return ""
    key = (type(integrator).__name__, h, sweeps, *_mark(mu), *_mark(lam))
    known = model._derived.setdefault(GROWTH, {})
    if key not in known:
        with torch.no_grad(), torch.autocast("cpu", enabled=False), torch.inference_mode(False), unheard():
            known[key] = measured(model, mu.double(), lam.double(), h, sweeps, integrator)
    return known[key]


def _mark(values: Tensor) -> tuple[float, ...]:
    """A rough key of moduli."""
    if values.numel() > 1:
        return (*_mark(values.amin()), *_mark(values.amax()), *_mark(values.mean()))
    number = abs(values.item())
    return (round(ALIKE * math.log2(number)) if 0 < number < math.inf else 0.0,)


def is_nearly_incompressible(mu: Tensor, lam: Tensor) -> bool:
    """Whether over-relaxed sweeps of some tet may gain energy from step to step."""
    return bool((lam.detach() > INCOMPRESSIBLE * mu.detach()).any())


def warn_of_units(model: Model, mu: Tensor, lam: Tensor, time_step: float) -> None:
    """Warns, in each call, of moduli and of a step that look as if they were in other units."""
    if time_step >= LONGEST_STEP:
        warn(f"time_step: {time_step:.4g} s is long for a step; times are in seconds: one of 1 ms is 0.001")
    most = float(mu.detach().max()) if mu.numel() else 0.0
    if not 0 < 2 * most < SOFTEST or not model.energy_mask & ELASTIC:
        return  # Young's modulus is 2 mu or more, unless Poisson's ratio is negative
    young = float((mu * (3 * lam + 2 * mu) / (mu + lam)).detach().nan_to_num(0.0).max())
    if young < SOFTEST:
        warn(f"mu: Young's modulus is at most {young:.4g} Pa, softer than any gel; moduli are in Pa: 1 MPa is 1e6")


def warn_of_over_relaxation(model: System, mu: Tensor, lam: Tensor) -> bool:
    """Warns of over-relaxed sweeps of what is nearly incompressible, whose growth may be too slow to be measured;
    whether it did."""
    if model.relaxation <= 1 or not model.energy_mask & ELASTIC:
        return False
    if not is_nearly_incompressible(mu, lam):
        return False
    warn(
        f"relaxation: {model.relaxation:g} where lam is more than {INCOMPRESSIBLE:g} times mu (Poisson's ratio "
        "above 0.492): such rollouts were seen to gain energy without bound; take relaxation=1, with "
        'subspace="coarse" in place of it',
    )
    return True


def warn_of_thin_tets(model: System, mu: Tensor, lam: Tensor, time_step: float, sweeps: int) -> None:
    """Warns of tets so thin that few sweeps leave a sheet without stiffness; moduli [Pa] that may be looked at.

    The two faces of a sheet are coupled (w / t)^2 times as stiffly as neighbours in its plane, w wide and t thick, and
    sweeps move them together by that much less; inertia helps where a wave crosses fewer elements than w / t. Coarse
    corrections move them together.
    """
    if model.coarse is not None:
        return
    aspect, height = model.derived("thinness", partial(thinness, model))
    if aspect < THIN:
        return
    needed = min(aspect, _crossed(model, mu, lam, time_step, height)) ** 2 * (2 - model.relaxation) / model.relaxation
    if sweeps < needed:
        warn(
            f"sweeps: {sweeps} at time_step = {time_step:.3g} s are too few for tets {aspect:.2g} times as wide as "
            f"thick, which need about {needed:.0f} or more: the body moves as if it had little stiffness; take a "
            f"shorter time step, more sweeps with relaxation up to {STABLE_RELAXATION}, or a thicker body of softer "
            "material. Linear tets this thin are also much too stiff in bending; " + page("numerics.md"),
        )


def _crossed(model: Model, mu: Tensor, lam: Tensor, time_step: float, height: float) -> float:
    """Number of tets of a height [m] that a pressure wave crosses in a step."""
    modulus = float((lam.detach() + 2 * mu.detach()).median())
    return time_step * (max(0.0, modulus) / float(model._density.median())) ** 0.5 / height


# --- motion that is lost ----------------------------------------------------------------------------------------------

FAR = 1e3  # sizes of the Model at rest


def size_of(model: System) -> float:
    """Diagonal of the Model's box at rest [m]."""
    return model.derived("size", lambda: float((model._rest_points.amax(0) - model._rest_points.amin(0)).norm()))


def reach_of(model: System, start: tuple[Tensor, ...], x: Tensor, gravity: Any, duration: float) -> Tensor:
    """Distance of the farthest vertex from its start, over the Model's size, less what its velocity, gravity and
    its pins may have given it [-]."""
    x0, v0 = (t.detach() for t in start)
    moved = (x.detach() - x0).abs()
    away = torch.where(model._pinned[:, None], 0.0, moved).amax()
    carried = torch.where(model._pinned[:, None], moved, 0.0).amax() + duration * v0.abs().amax()
    if isinstance(gravity, Tensor):
        carried = carried + 0.5 * duration**2 * gravity.detach().abs().amax()
    return (away - carried) / max(size_of(model), torch.finfo(x.dtype).tiny)


def notice_loss(model: System, prepared: Prepared, integrator: Integrator, v: Tensor, force: Any, end: Tensor) -> None:
    """Warns (UserWarning) where a step made one by one ends at positions that are not finite, or spread over more than
    FAR sizes of the Model; on the CPU. v: Before the step.

    A rollout looks at its own end, and tells from where it began how far is too far.
    """
    if end.is_cuda or not end.numel() or not looks_at(end) or is_silent():
        return
    low, high = map(float, end.detach().aminmax())
    if high - low <= FAR * size_of(model):
        return
    x = end.detach()
    spread = float((x.amax(-2) - x.amin(-2)).amax()) if math.isfinite(high - low) else math.inf
    if not spread <= FAR * size_of(model):
        where = f"spread over {spread:.3g} m" if spread < math.inf else "not finite"
        warn(f"x: this step ended with positions that are {where}: "
             f"{fault_of(model, prepared, integrator, v, force)}; " + page("numerics.md"))  # fmt: skip


def fault_of(model: System, prepared: Prepared, integrator: Integrator, v: Tensor, force: Any) -> str:
    """Cause of a lost step, and the remedy. v: Before it."""
    with torch.no_grad():
        if isinstance(force, Tensor):
            mass = prepared.mass[..., None].clamp(min=torch.finfo(v.dtype).tiny)
            push = broadcast(force.detach(), v.shape).reshape(-1, *v.shape[-2:]) / mass
            push = prepared.settings.numbers.time_step * torch.where(model._pinned[:, None], 0.0, push)
            if not float(push.norm()) <= float(v.detach().norm()):
                return ("force: in one step it changes velocities by more than they are, as an explicit drag or spring "
                        "does that is too strong for the step; limit it, or take a smaller time_step")  # fmt: skip
        if growth_message(model, prepared, integrator):
            return "sweeps: so few let vibrations grow in every step; take more, or a smaller relaxation or time_step"
    return "time step: too long for these speeds and loads; take a smaller time_step"


# --- states whose tets are bent or inside out -------------------------------------------------------------------------


def warn_of_inverted_bodies(model: Model, x: Tensor) -> None:
    """Warns where all tets of a body are inside out at the start x [..., V, 3], as where positions are mirrored."""
    if not model.energy_mask & ELASTIC or model.num_tets == 0 or x.numel() == 0:
        return
    states, tets = x.detach().reshape(-1, *x.shape[-2:]), model._topology[0]
    names, first, of = model.derived("bodies of tets", lambda: _bodies_of(model.body[tets[:, 0]]))
    if not inside_out(tets[first], states).any():  # as nearly always: a tet of each body is enough to see
        return
    upright = torch.zeros((len(states), len(names)), dtype=torch.int64, device=x.device)
    upright.index_add_(1, of, (~inside_out(tets, states)).long())
    whole = (upright == 0).nonzero()
    if len(whole):
        scene, body = int(whole[0, 0]), int(names[whole[0, 1]])
        others = f" and {len(whole) - 1} more" if len(whole) > 1 else ""
        warn(
            f"x: all tets of body {body} in scene {scene}{others} are inverted (J <= 0) at the start, as where "
            "positions are mirrored: it will turn itself inside out. Positions of another mesh need a Model of that "
            "mesh; checks=dv.Checks(start=False) starts without a word"
        )


def _bodies_of(labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Bodies [N] among the labels of tets [T], a tet of each [N], and which of them each tet is of [T]."""
    found = np.unique(labels.cpu(), return_index=True, return_inverse=True)
    names, first, of = (torch.as_tensor(a, device=labels.device) for a in found)
    return names, first, of


def warn_of_leaps(model: Model, v: Tensor, time_step: float) -> None:
    """Warns where a body goes by more than its own size in a step at the velocities v [..., V, 3]: contact solves for
    where it ends, and that may be behind what it should hit."""
    surface, barrier, size = model.surface_of_contact, model.contact, (-1, *v.shape[-2:])
    if surface is None or barrier is None or v.numel() == 0:
        return
    alone = bool(surface.plane_points[model.num_vertices :].all())  # no body passes a Plane
    if alone and (surface.bodies < 2 or not barrier.between_bodies):
        return
    sizes, counts = model.derived("sizes of bodies", lambda: _sizes_of(model))
    mean = v.new_zeros((v.reshape(size).shape[0], len(sizes), 3)).index_add_(1, model.body, v.detach().reshape(size))
    mean = mean / counts[:, None]
    if alone:
        mean = mean - mean.mean(1, keepdim=True)  # all together may be as fast as they like
    leap = time_step * mean.norm(dim=-1)
    over = (leap > sizes).nonzero()
    if len(over):
        scene, body = over[0].tolist()
        warn(
            f"v: body {body} in scene {scene} goes {leap[scene, body]:.2g} m in a step, more than its size, "
            f"{sizes[body]:.2g} m: contact may end the step with it behind what it should hit; take a smaller "
            "time_step; checks=dv.Checks(start=False) starts without a word"
        )


def _sizes_of(model: Model) -> tuple[Tensor, Tensor]:
    """Diagonal of each body's box at rest [bodies] [m], and how many vertices it has."""
    x, body, count = model.rest_points, model.body, model.mesh.num_bodies
    rows = body[:, None].expand(-1, 3)
    none = x.new_zeros((count, 3))
    high, low = (none.scatter_reduce(0, rows, x, way, include_self=False) for way in ("amax", "amin"))
    return (high - low).norm(dim=1), torch.bincount(body, minlength=count).to(x)


def warn_of_bending(model: Model, x: Tensor) -> None:
    """Warns of thin tets that a state x [..., V, 3] bends: linear ones lock."""
    aspect, height = model.derived("thinness", partial(thinness, model)) if model.num_tets else (0.0, 0.0)
    if aspect < THIN:
        return
    for vertices, terms, inverse in model.derived("affine maps", lambda: _affine_maps(model)):
        now = x.detach().reshape(-1, *x.shape[-2:])[:, vertices].double()
        off = (now - terms @ (inverse @ now)).square().sum(-1).mean(-1).sqrt()
        if float(off.max()) > BENT * height:
            warn(
                f"mesh: tets {aspect:.2g} times as wide as thick bend here: linear ones are too stiff for that, about "
                f"{TOO_STIFF * aspect**2:.0f} times; divide Young's modulus by as much where only bending counts, or "
                "take tets as wide as thick; " + page("numerics.md")
            )
            return


def _affine_maps(model: Model) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Of each of the first bodies its vertices [n], the terms of an affine map of them [n, 4], and their inverse."""
    out = []
    for body in range(min(MOST_BODIES, int(model.body.max()) + 1)):
        vertices = (model.body == body).nonzero()[:, 0]
        rest = model._rest_points[vertices].double()
        terms = torch.cat([torch.ones_like(rest[:, :1]), rest - rest.mean(0)], 1)
        out.append((vertices, terms, torch.linalg.pinv(terms)))
    return out
