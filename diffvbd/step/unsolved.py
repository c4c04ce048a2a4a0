"""How far a step ends from where it would converge, in the smooth motion of a body, by one evaluation of its residual.

What sweeps leave is of two kinds. A rough error is small, and gone in the next steps. A smooth one moves the body, and
sweeps hardly change it, so that their last changes do not show it. Here the residual r = -dG/dx is tested with the
polynomials of degree two of the body's rest shape, zero where it is pinned, which turn with the body by R:

    e = R Q (Q^T (M + h^2 K) Q)^-1 Q^T R^T r

is what a step of Newton's method among them would change. K is the stiffness at rest, with the blocks of planes and
springs at the state. What the next step keeps of it, (M + h^2 K)^-1 M e without those, is the error that counts: in
stiff motions it is gone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..adjoint.contact_potential import ContactPotential
from ..adjoint.potential import IncrementalPotential
from ..model.rest import shape_gradients
from ..model.system import System
from .arguments import Prepared, acceleration_of, collider_state
from .balance import contact_of_step, of_bodies, potential_of_step, rounding, share
from .integrators import Solve
from .predict import begin

DEPENDENT = 1e-9  # of the largest singular value: below it a polynomial is a combination of the others
NO_MATTER = 0.01  # of what forces did in the step: below it, it is not asked whether rounding left the error
CHUNK = 2000  # tets that are summed at once


class Unsolved(NamedTuple):
    """Of the body that a step left least balanced; root mean squares over its mass [m]."""

    scene: int
    body: int
    error: float  # what the next step keeps of e
    forced: float  # x' - (x + h v): what all forces did in the step


class _Functions(NamedTuple):
    """Of a body with n vertices and t tets."""

    vertices: Tensor  # int64 [n]
    tets: Tensor  # int64 [t], rows of the Model's
    rest: np.ndarray  # [n, 3]
    values: np.ndarray  # [n, f], zero where pinned


def _functions(model: System, body: int) -> _Functions:
    labels = model.body
    vertices = (labels == body).nonzero()[:, 0]
    rest = model._rest_points[vertices].double().cpu().numpy()
    low, high = rest.min(0), rest.max(0)
    x, y, z = ((rest - (low + high) / 2) / max(float((high - low).max()), 1e-300)).T
    terms = np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], 1)
    terms *= ~model._pinned[vertices].cpu().numpy()[:, None]
    left, size, _ = np.linalg.svd(terms, full_matrices=False)
    tets = (labels[model._topology[0][:, 0]] == body).nonzero()[:, 0]
    return _Functions(vertices, tets, rest, left[:, size > DEPENDENT * size[0]])


def _stiffness(model: System, of: _Functions, mu: Tensor, lam: Tensor) -> np.ndarray:
    """Q^T K Q at rest [N/m], [3 f, 3 f], the component first; mu, lam [1 | t]."""
    count, device = of.values.shape[1], mu.device
    values = torch.zeros(model.num_vertices, count, dtype=torch.float64, device=device)
    values[of.vertices] = torch.from_numpy(of.values).to(device)
    shear, bulk = torch.zeros(2, 3 * count, 3 * count, dtype=torch.float64, device=device)
    for first in range(0, len(of.tets), CHUNK):
        tets = model._topology[0][of.tets[first : first + CHUNK]]
        gradients, volume = shape_gradients(model._rest_points[tets].double())
        slopes = (gradients.mT @ values[tets]).flatten(1)  # of each function along each axis, [t, 3 f]
        for total, modulus in ((shear, mu), (bulk, lam)):
            part = modulus if len(modulus) == 1 else modulus[first : first + CHUNK]
            total += (slopes * (volume * part)[:, None]).T @ slopes
    sheared, pressed = (m.reshape(3, count, 3, count).cpu().numpy() for m in (shear, bulk))
    out = pressed + sheared.transpose(2, 1, 0, 3)
    for c in range(3):
        out[c, :, c] += np.einsum("cfcg->fg", sheared)
    return out.reshape(3 * count, 3 * count)


def unsolved(model: System, solve: Solve, x: Tensor, known: dict[tuple[int, int], np.ndarray]) -> Unsolved | None:
    """Of the solve that ended a step at x [..., V, 3]; None where no more is left than rounding leaves.

    known: Stiffness of bodies, of a Model and material; filled.
    """
    given, prepared = solve.given, solve.prepared
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        begun = begin(model, solve.x, solve.v, prepared, given["force"], acceleration_of(given["gravity"], solve.x),
                      given["prescribed"])  # fmt: skip
        end = x.reshape(begun.y.shape)
        end = end if begun.origin is None else end - begun.origin
        where = collider_state(model, solve.x, given["colliders"], given["colliders_before"])
        try:
            at = potential_of_step(model, end, begun, prepared, contact_of_step(model, begun, prepared, where))
            inertia, elastic = at.free * at.inertia(), at.free * at.elastic()
            forces = at.free * at.forces() if model.vertex_energies or where is not None else elastic
        except ValueError:  # surfaces that touch; the next step says where
            return None
        left, norm, scene, body = inertia + forces, of_bodies(model), 0, 0
        bodies = model.derived("labelled", lambda: int(model.body.max()) + 1)
        if len(end) * bodies > 1:
            ratio = share(norm(left), norm(inertia) + norm(forces))
            scene, body = divmod(int(ratio.argmax()), bodies)
        carried = prepared.settings.numbers.time_step * solve.v.reshape(end.shape)[scene]
        forced = end[scene] - begun.x_prev[scene] - carried
        found = _of_body(model, at, prepared, scene, body, left, forced, bool((forces != elastic).any()), known)
        if found.error <= NO_MATTER * found.forced:
            return found
        return found if float(norm(left)[scene, body]) > float(rounding(at, norm)[scene, body]) else None


def _of_body(model: System, at: IncrementalPotential, prepared: Prepared, scene: int, body: int, left: Tensor,
             forced: Tensor, pushed: bool, known: dict[tuple[int, int], np.ndarray]) -> Unsolved:  # fmt: skip
    of = model.derived(f"smooth functions of body {body}", lambda: _functions(model, body))
    rows, q, count = of.vertices, of.values, of.values.shape[1]

    def own(value: Tensor) -> Tensor:
        return value[min(scene, len(value) - 1)]

    def array(value: Tensor) -> np.ndarray:
        return own(value)[rows].double().cpu().numpy()

    weight, now, residual = array(at.mass), array(at.x), -array(left)
    mass = weight * array(at.free[None])
    total = max(float(mass.sum()), 1e-300)
    if (scene, body) not in known:
        mu, lam = (own(m).double() for m in (prepared.mu, prepared.lam))
        if len(mu) == len(lam) == 1:
            one, none = torch.ones_like(mu), torch.zeros_like(mu)
            of_mu, of_lam = model.derived(f"unit stiffness of body {body}", lambda: (
                _stiffness(model, of, one, none), _stiffness(model, of, none, one)))  # fmt: skip
            known[scene, body] = float(mu) * of_mu + float(lam) * of_lam
        else:
            mu, lam = (m if len(m) == 1 else m[of.tets] for m in (mu, lam))
            known[scene, body] = _stiffness(model, of, mu, lam)
    matrix = at.h**2 * known[scene, body].reshape(3, count, 3, count)
    gram = q.T @ (mass * q)
    for c in range(3):
        matrix[c, :, c] += gram
    elastic = matrix.copy().reshape(3 * count, -1)

    arms = [a - (weight * a).sum(0) / weight.sum() for a in (now, of.rest)]
    u, _, vt = np.linalg.svd(arms[0].T @ (weight * arms[1]))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    added = [energy.blocks(at.x, at.x_prev, data, at.h, at.origin) for energy, data in at._vertex_energies(at.data)]
    if isinstance(at, ContactPotential):  # as stiff along a surface as across it
        trace = at.h**2 * at.step_contact.stiffness(at.contact)
        added.append(trace[..., None, None] * torch.eye(3, dtype=trace.dtype, device=trace.device))
    for blocks in map(array, added if pushed else ()):
        acts = blocks.any((1, 2)) & (mass[:, 0] > 0)
        if acts.any():
            matrix += np.einsum("nf,ncd,ng->cfdg", q[acts], turn.T @ blocks[acts] @ turn, q[acts], optimize=True)
    force = (q.T @ (residual @ turn)).T.reshape(-1)
    way = np.linalg.solve(matrix.reshape(3 * count, -1), force).reshape(3, count)
    kept = np.linalg.solve(elastic, (way @ gram).reshape(-1)).reshape(3, count)
    error = (kept @ gram * kept).sum()
    return Unsolved(scene, body, float(max(error, 0.0) / total) ** 0.5,
                    float((mass * array(forced[None]) ** 2).sum() / total) ** 0.5)  # fmt: skip
