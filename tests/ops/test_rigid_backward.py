"""Claim: the derivatives that the adjoint of rigid corrections takes of pairs are those of their virtual work.

The work is written out in torch here and derived by autograd. Where sides are of two groups, each bears twice the
stiffness. Friction is that after q, and after twice the q of such a side.
"""

import importlib
from typing import Any

import numpy as np
import pytest
import torch
from conftest import DEVICES
from torch import Tensor

import diffvbd as dv
from diffvbd import mesh, ops
from diffvbd.adjoint.contact_lag import Pairs, at_corners
from diffvbd.ops import contact as contact_rigid
from diffvbd.step.rigid_terms import Scenes, pair_terms
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import SCENES, compiled, noise

corrections = importlib.import_module("diffvbd.step.corrections")
DIFFERENTIABLE = ("x", "x_prev", "collider", "collider_prev", "kappa", "lag")


def many() -> Any:
    """Nine pairs of boxes that touch, and a stack of more than a group may have, with friction; one box is
    pinned."""
    box = mesh.box(2, 0.1)
    places = np.array([[0.3 * (k % 6), 0.0, 0.3 * (k // 6)] for k in range(9)])
    stack = np.array([[-0.4 + 0.013 * (k % 2), 0.105 * k, 0.0] for k in range(contact_rigid.MOST_COUPLED + 4)])
    tets = mesh.replicate(box, np.concatenate([places, places + [0.013, 0.105, 0.017], stack]))
    model = dv.Model(tets, pinned=range(8), energies=(dv.StableNeoHookean(), dv.PairBarrier(1e3, 0.01, damping=2.0),
                                                      dv.Friction(0.4, 0.05)))  # fmt: skip
    x = model.rest_points + noise("many", shape=model.rest_points.shape, size=5e-4)
    return model, x, noise("many", "v", shape=x.shape, size=0.2)


def fields_of(monkeypatch: pytest.MonkeyPatch, name: str) -> Scenes:
    """What a correction in a step of a scene reads: the last that has pairs."""
    seen: list[Scenes] = []

    def correct(model: dv.Model, fields: ops.TouchingFields, time_step: float, eps: float, *options: Any) -> Any:
        if fields.pairs.shape[0]:
            seen.append(Scenes(model, ops.TouchingFields(*(t.detach().contiguous() for t in fields)), time_step, eps))
        return original(model, fields, time_step, eps, *options)

    original = corrections.correct
    monkeypatch.setattr(corrections, "correct", correct)
    if name == "many":
        model, x, v = many()
        dv.step(model, x, v, mu=1e5, lam=1e5, time_step=0.01, sweeps=2)
    else:
        compiled(SCENES[name](), 2, 2)
    return seen[-1]


def groups_of(s: Scenes) -> Tensor:
    """[B, 4, bodies], or empty."""
    return contact_rigid.rigid_system(s.fields, s.model._data_count, s.time_step, s.friction_eps)[3]


def parts_of(s: Scenes, listed: Pairs, moved: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Of how corners move [2, n, 4, 3], what is solved for at once, with its share of the stiffness [n, 1]."""
    f, count = s.fields, s.fields.free.shape[0]
    corners, kind = listed.pairs[:, :4].long(), listed.pairs[:, 4:5].long()
    sides = torch.where(kind == 1, 2, 1)
    lead = f.body.long()[torch.cat([corners[:, :1], corners.gather(1, sides)], 1)]
    moves = (lead < count) & f.free[lead.clamp(max=count - 1)]
    groups = groups_of(s)
    apart = moves.all(1) & torch.tensor(groups.numel() > 0)
    if groups.numel():
        assert count > contact_rigid.FEW
        first = groups[listed.pairs[:, 5:].long(), 1, lead.clamp(max=count - 1)]
        apart = apart & (first[:, 0] != first[:, 1])
    first = (torch.arange(4) < sides)[..., None]
    share = torch.where(apart, 2.0, 1.0)[:, None]
    one = torch.where(apart[:, None, None] & ~first, 0.0, moved).sum(2)
    other = torch.where(apart[:, None, None] & ~first, moved, 0.0).sum(2)
    return [(one, share), (other, share)]


def work(s: Scenes, p: Tensor, q: Tensor) -> Tensor:
    total = work_of_lagged(s, p, q) if s.fields.lag.numel() else p.new_zeros(())
    for terms in pair_terms(s):
        if terms.at_corners is None:
            continue
        # barriers within a body do nothing to its rigid motion
        corners, second = terms.listed.pairs[:, :4].long(), torch.where(terms.listed.pairs[:, 4:5] == 1, 2, 1)
        body = s.fields.body
        apart = (body[corners[:, :1]] != body[corners.gather(1, second)]).to(p)
        moved = torch.stack([at_corners(p, terms.listed), at_corners(q, terms.listed)])
        total = total + (apart[..., None] * terms.at_corners * moved[0]).sum()
        moved = terms.weights[..., None] * moved
        total = total + (apart * terms.force * moved[0].sum(1)).sum()
        for part, share in parts_of(s, terms.listed, moved):
            pressed = (terms.stiffness @ part[1][..., None])[..., 0]
            total = total + (apart * share * part[0] * pressed).sum()
    return total


def work_of_lagged(s: Scenes, p: Tensor, q: Tensor) -> Tensor:
    """Of friction and damping."""
    f, h = s.fields, s.time_step
    load, damping, n, w = f.lag.split((1, 1, 3, 4), -1)

    def across(u: Tensor) -> Tensor:
        return u - n * (n * u).sum(-1, keepdim=True)

    def rate(u: Tensor) -> Tensor:
        length = u.square().sum(-1, keepdim=True).sqrt()
        sticks = length < s.friction_eps
        return h**2 * load * torch.where(sticks, (2 - length / s.friction_eps) / s.friction_eps, 1 / length)

    since = torch.cat([f.x, f.collider], 1) - torch.cat([f.x_prev, f.collider_prev], 1)
    moved = torch.stack([at_corners(t, s.lagged) for t in (p, q, since)])
    whole = (w[..., None] * moved).sum(2)
    approach = (n * whole[2]).sum(-1, keepdim=True).clamp(max=0)
    damped = h * damping * approach * (n * whole[0]).sum(-1, keepdim=True)
    rubbed = torch.zeros_like(damped)
    for part, share in parts_of(s, s.lagged, w[..., None] * moved[:2]):
        end = across(whole[2] + share * part[1])
        rubbed = rubbed + (part[0] * rate(end) * end).sum(-1, keepdim=True)
        along = (n * part).sum(-1, keepdim=True)
        damped = damped + h * damping * share * along[0] * along[1]
    return (damped + rubbed).sum()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ("stacked", "crossed", "batched", "many"))
def test_derivatives_are_those_of_the_virtual_work(name: str, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    s = fields_of(monkeypatch, name)
    f = s.fields
    points = (f.x.shape[0], f.body.shape[0], 3)
    body = f.body.long()
    moves = torch.cat([f.free, f.free.new_zeros(int(body.max()) + 1 - len(f.free))])[body][:, None]
    p, q = (torch.where(moves, noise(name, key, shape=points, size=0.1), 0.0) for key in ("p", "q"))

    given = {key: getattr(f, key) for key in DIFFERENTIABLE} | {"p": p, "q": q}
    leaves = {key: value.clone().requires_grad_() for key, value in given.items()}
    own: Any = {key: leaves[key] for key in DIFFERENTIABLE}
    total = work(s._replace(fields=f._replace(**own)), leaves["p"], leaves["q"])
    grads = torch.autograd.grad(total, list(leaves.values()), allow_unused=True, materialize_grads=True)
    expected = dict(zip(leaves, grads, strict=True))

    found = contact_rigid.rigid_backward(
        ops.TouchingFields(*(t.to(device) for t in f)), p.to(device), q.to(device), groups_of(s).to(device),
        s.model._data_count, s.time_step, s.friction_eps,
    )  # fmt: skip
    by_x, by_p, by_q, since, by_kappa, lag_bar = (t.cpu() for t in found)

    vertices = f.x.shape[1]
    before = -since if len(since) else torch.zeros_like(by_x)
    scene = f.pairs[:, 5].long() if f.kappa.shape[0] > 1 else torch.zeros_like(f.pairs[:, 5]).long()
    result = {"x": by_x[:, :vertices], "x_prev": before[:, :vertices], "collider": by_x[:, vertices:],
              "collider_prev": before[:, vertices:], "kappa": torch.zeros_like(f.kappa).index_add(0, scene, by_kappa),
              "lag": -lag_bar, "p": by_p, "q": by_q}  # fmt: skip
    for key in ("x", "kappa", "p", "q", *(("x_prev", "lag") if f.lag.numel() else ())):
        assert float(expected[key].abs().max()) > 0, key
    for key, value in expected.items():
        # p and q are zero at corners that do not move, and their derivatives are not used there; nor are those of pairs
        # that do nothing, which lists may hold
        acts = f.lag[:, :1] + f.lag[:, 1:2] > 0
        used = moves if key in ("p", "q") else acts if key == "lag" else torch.ones_like(moves[:1, 0])
        error = relative_error(torch.where(used, result[key], 0.0), torch.where(used, value, 0.0))
        assert error <= tolerance("contact_adjoint"), key
