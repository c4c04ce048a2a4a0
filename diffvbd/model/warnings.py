"""Warnings of safeguards, units, thin tets and states outside the range in which they make sense (docs/numerics.md)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .._common.constants import ELASTIC
from .._common.context import looks_at
from .._common.messages import page, warn
from .model import Model
from .system import System

INCOMPRESSIBLE = 60.0  # lam / mu (nu = 0.492) above which over-relaxed rollouts grew; 49 did not
STABLE_RELAXATION = 1.7  # largest omega that never grew in the rollouts of docs/numerics.md
HEAVY_REGULARIZATION = 0.1  # of the lightest vertex
THIN = 10.0  # longest edge over shortest height; those of a cube have 2.4
TOO_STIFF = 0.55  # times aspect^2: so much too stiff were sheets of one layer, from 3.4 to 24
MOST_BODIES = 8  # whose bending is looked at
BENT = 0.01  # of the height of a tet, by which a body is no longer an affine image of its rest shape
SOFTEST = 10.0  # [Pa] Young's modulus; soft gels have 100 Pa or more
LONGEST_STEP = 1.0  # [s]


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
    aspect, height = thinness(model)
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


def warn_of_bending(model: Model, x: Tensor) -> None:
    """Warns of thin tets that a state x [..., V, 3] bends: linear ones lock."""
    aspect, height = thinness(model) if model.num_tets else (0.0, 0.0)
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


def _crossed(model: Model, mu: Tensor, lam: Tensor, time_step: float, height: float) -> float:
    """Number of tets of a height [m] that a pressure wave crosses in a step."""
    modulus = float((lam.detach() + 2 * mu.detach()).median())
    return time_step * (max(0.0, modulus) / float(model._density.median())) ** 0.5 / height


# --- how thin the tets of a mesh are, and which tets of a state are inside out ----------------------------------------


def height_of_tets(model: Model) -> np.ndarray:
    """The shortest of each tet's four heights [m], [T]."""
    return model.derived("shapes of tets", lambda: _shapes_of_tets(model))[0]


def thinness(model: Model) -> tuple[float, float]:
    """Longest edge over shortest height [-], and that height [m], of the median tet."""
    return model.derived("shapes of tets", lambda: _shapes_of_tets(model))[1:]


def _shapes_of_tets(model: Model) -> tuple[np.ndarray, float, float]:
    corners = model.mesh.points[model.mesh.tets]
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.stack([np.cross(edges[:, i], edges[:, j]) for i, j in ((1, 2), (2, 0), (0, 1))], 1)
    volume = np.abs((edges[:, 0] * normals[:, 0]).sum(-1))
    normals = np.concatenate([normals, -normals.sum(1, keepdims=True)], 1)
    height = volume / np.linalg.norm(normals, axis=-1).max(1)
    sides = np.linalg.norm(corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]], axis=-1)
    return height, float(np.median(sides.max(1) / height)), float(np.median(height))


def inside_out(tets: Tensor, x: Tensor) -> Tensor:
    """Tets [T, 4] of states [..., V, 3] with a volume of 0 or less, bool [..., T]."""
    corners = x.detach()[..., tets, :]
    a, b, c = (corners[..., 1:, :] - corners[..., :1, :]).unbind(-2)
    return (torch.linalg.cross(a, b) * c).sum(-1) <= 0
