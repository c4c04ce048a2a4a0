"""Claim: the compiled adjoint of the rigid correction of bodies that touch is that which autograd derives of it."""

import importlib
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from helpers.vertex_terms import Scenes, vertex_blocks, vertex_gradient
from torch import Tensor

import diffvbd as dv
from diffvbd import mesh, ops
from diffvbd.adjoint.contact import of_scene
from diffvbd.ops import broadcast
from diffvbd.ops import contact as ops_rigid
from diffvbd.ops.autograd import in_shape
from diffvbd.ops.fields import MOST_COUPLED
from diffvbd.reference.rigid_contact import LEAST_INERTIA
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import noise

rigid_contact = importlib.import_module("diffvbd.step.contact_rigid")
ELASTIC = dv.StableNeoHookean()


def pile(*energies: Any, heights: Sequence[int] = (2,), anchored: bool = False, scenes: int = 1, closing: float = 0.0,
         dtype: torch.dtype = torch.float64) -> tuple[dv.Model, Tensor, Tensor]:  # fmt: skip
    """Boxes one above the other over a floor at -5 mm that the lowest touch; x and v [scenes, V, 3]. closing: At which
    the first and the third come toward the second [m/s]."""
    box = mesh.box(2, 0.1)
    places = [[0.5 * n + 0.013 * (k % 4), 0.105 * k, 0.017 * (k % 4)] for n, high in enumerate(heights)
              for k in range(high)]  # fmt: skip
    tets = mesh.join([box.translate(p) for p in places])
    if anchored:
        spring = torch.zeros(tets.num_vertices)
        spring[:3] = 50.0
        energies = (*energies, dv.Anchor(stiffness=spring, points=torch.from_numpy(tets.points) + 0.01))
    model = dv.Model(tets, energies=(ELASTIC, *energies)).to(dtype=dtype)
    shape = (scenes, *model.rest_points.shape)
    x = model.rest_points + noise("pile", shape=shape, size=5e-4).to(dtype)
    v = noise("pile", "v", shape=shape, size=0.3).to(dtype)
    v[..., 1] += closing * (1 - model.body.to(dtype))
    return model, x, v


FLOOR = dv.FloorBarrier([-0.005, -0.3], [(0.0, 1.0, 0.0), (0.3, 1.0, 0.1)], kappa=1e3, dhat=0.01, damping=3.0)
PAIRS = dv.PairBarrier(1e3, 0.01, damping=2.0)
CASES = {
    "floor": ((FLOOR, dv.Friction(0.4)), {"heights": (1,)}),
    "pairs": ((PAIRS, dv.Friction(0.4)), {}),
    "all": ((FLOOR, PAIRS, dv.Friction(0.4)), {"anchored": True, "heights": (3,)}),
    "batched": ((FLOOR, PAIRS, dv.Friction(0.4)), {"scenes": 3}),
    # more than sixty-four: groups of three and two, and those of a stack that is too high, each alone
    "many": ((PAIRS, dv.Friction(0.4, 0.05)), {"heights": (3, MOST_COUPLED + 1, 2, 1), "scenes": 2}),
    "single": ((FLOOR, PAIRS, dv.Friction(0.4)), {"dtype": torch.float32}),
    "held": ((FLOOR, PAIRS, dv.Friction(0.4)), {"heights": (3,), "closing": 6.0}),
}


def solved(factor: Tensor, groups: Tensor, right: Tensor) -> Tensor:
    """[B, bodies, 6] of all systems."""
    if groups.numel() == 0:
        return torch.cholesky_solve(right.reshape(*factor.shape[:-1], 1), factor).reshape(right.shape)
    out = torch.zeros_like(right)  # of bodies that do not move, which have no factor
    for scene, (member, _, _, count) in enumerate(groups.long()):
        for place in count.nonzero()[:, 0].tolist():
            bodies = member[place : place + abs(int(count[place]))]
            size = 6 * len(bodies)
            if size > factor.shape[-1]:
                continue
            own = factor[scene, place:].reshape(-1)[: size * size].reshape(size, size)
            out[scene, bodies] = torch.cholesky_solve(right[scene, bodies].reshape(-1, 1), own).reshape(-1, 6)
    return out


def by_autograd(s: Scenes, x_bar: Tensor, share: Tensor, motion: Tensor, factor: Tensor, groups: Tensor,
                needs: Sequence[bool]) -> tuple[Tensor, ...]:  # fmt: skip
    """Of the fields that need one. With H d = -g, the adjoint of d is that of -l . (g + H d), where H l is the adjoint
    of d: a sum over vertices, derived by autograd, and over pairs, derived by the compiled operator."""
    f = s.fields
    body = f.body[: f.x.shape[1]].long()
    leaf = motion.to(f.x.dtype).requires_grad_()
    arm, whole = _arms(f, body)
    end = f.x + _displaced(share.to(f.x.dtype)[..., None] * leaf, arm, body)
    wanted = [t for t, need in zip(f, needs, strict=True) if need]
    *first, bar = torch.autograd.grad(end, (*wanted, leaf), x_bar, allow_unused=True, retain_graph=True)
    solution = solved(factor, groups, bar.to(factor.dtype))
    # of a matrix that was not positive definite no motion came, and nothing goes back through it
    moved = f.free & torch.isfinite(solution).all(-1)
    solution = torch.where(moved[..., None], solution, 0.0).to(f.x.dtype)
    virtual = -_virtual_work(s, solution, leaf.detach(), arm, whole, body, groups)
    second = torch.autograd.grad(virtual, wanted, allow_unused=True)
    return tuple(_sum(pair, t) for pair, t in zip(zip(first, second, strict=True), wanted, strict=True))


def _sum(parts: tuple[Tensor | None, ...], like: Tensor) -> Tensor:
    out = torch.zeros_like(like)
    for part in parts:
        out = out if part is None else out + part
    return out.detach()


def _of_bodies(values: Tensor, f: ops.TouchingFields, body: Tensor) -> Tensor:
    """Sums over the vertices of each body [B, bodies, n]."""
    return values.new_zeros(len(values), len(f.free), values.shape[-1]).index_add(1, body, values)


def _arms(f: ops.TouchingFields, body: Tensor) -> tuple[Tensor, Tensor]:
    """Where vertices are from the centers of mass of their bodies [B, V, 3], and the masses of these [B, bodies]."""
    mass = broadcast(f.mass, f.x.shape[:2])[..., None]
    sums = _of_bodies(torch.cat([mass, mass * f.x], -1), f, body)
    whole = sums[..., :1].clamp(min=torch.finfo(f.x.dtype).tiny)
    return f.x - (sums[..., 1:] / whole)[:, body], sums[..., 0]


def _displaced(motion: Tensor, arm: Tensor, body: Tensor) -> Tensor:
    """What a turn and a shift of each body [B, bodies, 6] do to its vertices, exactly, [B, V, 3]."""
    w, shift = motion.split(3, -1)
    square = (w * w).sum(-1, keepdim=True)
    small = square < 1e-8
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    first = torch.where(small, 1 - square / 6, torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / safe)
    w, first, second, shift = torch.cat([w, first, second, shift], -1)[:, body].split((3, 1, 1, 3), -1)
    turned = torch.linalg.cross(w, arm)
    return first * turned + second * torch.linalg.cross(w, turned) + shift


def without_friction(s: Scenes) -> Scenes:
    """On a floor."""
    return s._replace(fields=s.fields._replace(floor_lag=s.fields.x.new_zeros((0,))))


def _virtual_work(s: Scenes, p: Tensor, q: Tensor, arm: Tensor, whole: Tensor, body: Tensor, groups: Tensor
                  ) -> Tensor:  # fmt: skip
    """p . (gradient + matrix q + friction after q), for motions p and q of all bodies [B, bodies, 6]."""
    f = s.fields
    at_p, at_q = (torch.linalg.cross(m[:, body, :3], arm) + m[:, body, 3:] for m in (p, q))
    mass = broadcast(f.mass, f.x.shape[:2])[..., None]
    bare = without_friction(s)
    # friction is that after q: the same as of vertices that began the step that much farther back
    after = s._replace(fields=f._replace(x_prev=f.x_prev - at_q))
    rubbed = vertex_gradient(after) - vertex_gradient(without_friction(after))
    own, blocks = vertex_gradient(bare) + rubbed + mass * at_q, vertex_blocks(bare)
    if blocks is not None:
        own = own + (blocks * at_q[..., None, :]).sum(-1)
    spread = _of_bodies(mass * arm.square().sum(-1, keepdim=True), f, body)
    least = (p * q)[..., :3].mul(spread).sum()
    work = (at_p * own).sum() + LEAST_INERTIA * least
    return work + _work_of_pairs(s, at_p, at_q, groups)


def _work_of_pairs(s: Scenes, at_p: Tensor, at_q: Tensor, groups: Tensor) -> Tensor:
    """A scalar with the derivatives of what pairs add to the virtual work, but another value."""
    f, rest = s.fields, torch.zeros_like(s.fields.collider)
    at_p, at_q, points = (torch.cat([t, u], 1) for t, u in ((at_p, rest), (at_q, rest), (f.x, f.collider)))
    found = ops_rigid.rigid_backward(
        ops.TouchingFields(*(t.detach() for t in f)), at_p.detach(), at_q.detach(), groups, s.model._data_count,
        s.time_step, s.friction_eps,
    )  # fmt: skip
    work = (found.by_x * points + found.by_p * at_p + found.by_q * at_q).sum()
    if len(found.by_kappa):
        kappa = f.kappa if f.kappa.shape[0] == 1 else of_scene(f.kappa, rigid_contact.listed_of(f))
        work = work + (kappa * found.by_kappa).sum()
    if len(found.since):
        before = torch.cat([f.x_prev, f.collider_prev], 1)
        work = work - (found.since * before).sum() - (f.lag * found.lag_bar).sum()
    return work


def derived(s: Scenes, needs: Sequence[bool], *given: Tensor) -> tuple[Tensor, ...]:
    with torch.enable_grad():
        leaves = (t.detach().requires_grad_(need and t.is_floating_point())
                  for t, need in zip(s.fields, needs, strict=True))  # fmt: skip
        return by_autograd(s._replace(fields=ops.TouchingFields(*leaves)), *given, needs)


def of_all(s: Scenes, needs: Sequence[bool], x_bar: Tensor, made: ops_rigid.Made) -> list[Tensor]:
    """The same of corrections one after another: what x has goes on to the one before, the rest adds up."""
    total: list[Tensor] = []
    for x, motion, share, factor, groups in reversed(list(zip(*made, strict=True))):
        bars = derived(s._replace(fields=s.fields._replace(x=x)), needs, x_bar, share, motion, factor, groups)
        assert needs[0]
        x_bar = bars[0]
        total = [x_bar, *(a + b for a, b in zip(total[1:], bars[1:], strict=True))] if total else list(bars)
    return total


@pytest.mark.parametrize("name", CASES)
def test_compiled_adjoint_is_that_of_autograd(name: str, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    energies, options = CASES[name]
    model, x, v = pile(*energies, **options)
    model, x, v = model.to(device), x.to(device), v.to(device)
    compiled, seen, longest = rigid_contact._adjoints, {}, []

    def both(f: ops.TouchingFields, x_bar: Tensor, made: ops_rigid.Made, needs: Sequence[bool], *options: Any) -> Any:
        found, s = compiled(f, x_bar, made, needs, *options), Scenes(options[0], f, options[1], options[2] or 1.0)
        names = [field for field, need in zip(ops.TouchingFields._fields, needs, strict=True) if need]
        bars = [in_shape(bar, t) for bar, t, need in zip(found, s.fields, needs, strict=True) if need]
        longest.append(len(made.x))
        expected = of_all(s, needs, x_bar, made)
        for field, own, other in zip(names, bars, expected, strict=True):
            size = float(other.norm())
            seen[field] = max(seen.get(field, 0.0), size)
            assert own.shape == other.shape, field
            if size > 0:
                limit = tolerance("contact_adjoint" if own.dtype == torch.float64 else "contact_float32")
                assert relative_error(own, other) <= limit, field
        return found

    monkeypatch.setattr(rigid_contact, "_adjoints", both)
    leaves = {"x": x, "v": v, "density": x.new_full((), 1e3)}
    parameters = {"floor_kappa": 1e3} if dv.FloorBarrier in map(type, energies) else {}
    parameters |= {"pair_kappa": 1e3} if dv.PairBarrier in map(type, energies) else {}
    values = {key: x.new_full((), value).requires_grad_() for key, value in parameters.items()}
    for leaf in leaves.values():
        leaf.requires_grad_()
    end = dv.step(model, leaves["x"], leaves["v"], dv.VBD(0.01, 2), mu=1e5, lam=1e5, density=leaves["density"],
                  **values)  # fmt: skip
    sum(((t * noise(name, shape=t.shape, size=1.0).to(t)).sum() for t in end), x.new_zeros(())).backward()
    assert (max(longest) > 1) == (name in ("many", "held"))
    wanted = {"x", "x_prev", "y", "mass"} | ({"lag"} if "pair_kappa" in values else {"floor_lag"})
    assert all(seen[field] > 0 for field in wanted), seen
    assert all(
        float(leaf.grad.abs().max()) > 0 for leaf in (*leaves.values(), *values.values()) if leaf.grad is not None
    )
