"""Claim: an elastic law may read where its corners were at the start of the step, and its gradients are exact.

A law with viscosity, stable Neo-Hookean plus c mu / 2 V |F - F_prev|^2, is put in place of it in a copy of the sources.
"""

from pathlib import Path

import pytest
from helpers.copied_sources import build, copy_sources, edit, run
from helpers.paths import needs_csrc

LAW = """#pragma once

#include "stable_neo_hookean.h"

namespace diffvbd {

template <bool Exact>
struct Damped : StableNeoHookean<Exact> {
  using Base = StableNeoHookean<Exact>;
  template <class R>
  using View = typename Base::template View<R>;
  static constexpr double viscosity = 0.5;  // c

  template <class R>
  DIFFVBD_FN static R damping(const TetPair<R>& e) {
    return R(viscosity) * Base::mu(e);
  }
  template <class R>
  DIFFVBD_FN static R stiffness(const TetPair<R>& e) {
    return R(0) - (Base::k_ij(e) + Base::k_ik(e) + Base::k_il(e));
  }
  // differences of the corners' way since the start of the step; d = x_i - x_j
  template <class R>
  struct Ways {
    Vec3<R> j, k, l;
  };
  template <class R>
  DIFFVBD_FN static Ways<R> ways(const TetPair<R>& e, const Vec3<R>& d) {
    const Vec3<R> i = e.before(0);
    return {i - e.before(1) - d, e.xk - e.xj - d + i - e.before(2), e.xl - e.xj - d + i - e.before(3)};
  }
  template <class R>
  DIFFVBD_FN static Vec3<R> rate(const TetPair<R>& e, const Ways<R>& w) {
    return Base::k_ij(e) * w.j + Base::k_ik(e) * w.k + Base::k_il(e) * w.l;
  }
  // where the adjoint looks: at x_i + d_raw
  template <class R>
  DIFFVBD_FN static Ways<R> after(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw) {
    return ways(e, Exact ? v.d : v.d + d_raw);
  }

  template <class R>
  DIFFVBD_FN static void block(const TetPair<R>& e, const Vec3<R>& xi, Vec3<R>& g, R& h_diagonal, Sym3<R>& h_outer) {
    Base::block(e, xi, g, h_diagonal, h_outer);
    g += damping(e) * rate(e, ways(e, xi - e.xj));
    h_diagonal = h_diagonal + damping(e) * stiffness(e);
  }
  template <class R>
  DIFFVBD_FN static TetAdjoint<R> block_vjp(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw,
                                            const Vec3<R>& p, const R& minus_h2) {
    TetAdjoint<R> out = Base::block_vjp(e, v, d_raw, p, minus_h2);
    const Vec3<R> w = (minus_h2 * damping(e)) * p;
    out.xi += stiffness(e) * w;
    out.xj += Base::k_ij(e) * w;
    out.xk += Base::k_ik(e) * w;
    out.xl += Base::k_il(e) * w;
    return out;
  }
  template <class R>
  DIFFVBD_FN static void material_vjp(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& p,
                                      const R& minus_h2, R* bar) {
    Base::material_vjp(e, v, d_raw, p, minus_h2, bar);
    bar[0] = bar[0] + minus_h2 * R(viscosity) * dot(rate(e, after(e, v, d_raw)), p);
    const R weight[4] = {R(0) - stiffness(e), R(0) - Base::k_ij(e), R(0) - Base::k_ik(e), R(0) - Base::k_il(e)};
    for (int c = 0; c < 4; ++c) {
      const Vec3<R> of = (minus_h2 * damping(e) * weight[c]) * p;
      R* to = bar + kMaterialScalars + 3 * c;
      to[0] = of.x, to[1] = of.y, to[2] = of.z;
    }
  }
  template <class R>
  DIFFVBD_FN static void rest_vjp(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& p,
                                  const R& minus_h2, R* bar) {
    Base::rest_vjp(e, v, d_raw, p, minus_h2, bar);
    const Ways<R> w = after(e, v, d_raw);
    const R b = minus_h2 * damping(e);
    bar[0] = bar[0] + b * dot(w.j, p), bar[1] = bar[1] + b * dot(w.k, p), bar[2] = bar[2] + b * dot(w.l, p);
  }
  template <class R>
  DIFFVBD_FN static void apply(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& p,
                               Vec3<R>& g_sum, Vec3<R>& p_sum) {
    Base::apply(e, v, d_raw, p, g_sum, p_sum);
    g_sum += damping(e) * rate(e, after(e, v, d_raw));
    p_sum += (damping(e) * stiffness(e)) * p;
  }
  template <class R>
  DIFFVBD_FN static R value(const Vec3<R> (&x)[4], const R* rest, const R* material) {
    R sum = R(0);
    for (int a = 0; a < 4; ++a) {
      for (int b = a + 1; b < 4; ++b) {
        const R *p = material + kMaterialScalars + 3 * a, *q = material + kMaterialScalars + 3 * b;
        const Vec3<R> way = x[a] - x[b] - Vec3<R>{p[0] - q[0], p[1] - q[1], p[2] - q[2]};
        sum = sum - rest[weight_index(a, b)] * dot(way, way);
      }
    }
    return Base::value(x, rest, material) + R(0.5 * viscosity) * material[0] * sum;
  }
};

}  // namespace diffvbd
"""

SCRIPT = """
import sys
import torch
import diffvbd as dv
from diffvbd.testing import tolerance
from diffvbd.testing.scenes import structured

device = sys.argv[1] if len(sys.argv) > 1 else "cpu"
torch.manual_seed(0)
mesh = dv.TetMesh(*structured((2, 1, 1), (0.2, 0.1, 0.1)))
model = dv.Model(mesh, pinned=[0, 1], density=1000.0).to(device)
n, t = mesh.num_vertices, len(mesh.tets)
try:
    dv.step(model, model.rest_points, 0 * model.rest_points, dv.VBD(0.01, 1, subspace="coarse"), mu=1e4, lam=1e4)
    raise AssertionError
except ValueError as error:
    assert "reads where a step began" in str(error), error
f64 = {"dtype": torch.float64, "device": device}
h, viscosity = 0.01, 0.5
x = model.rest_points + 0.01 * torch.randn(2, n, 3, **f64)
v = 0.5 * torch.randn(2, n, 3, **f64)
v[:, :2] = 0
mu, lam = 2e4 * (1 + torch.rand(t, **f64)), 3e4 * (1 + torch.rand(t, **f64))
gravity = (0.0, -9.8, 0.0)


def gradient(end, viscosity):
    # of the incremental potential, by autograd, from formulas of its own
    end = end.detach().requires_grad_()
    corners = model.rest_points[model.tets]
    rest = (corners[:, 1:] - corners[:, :1]).transpose(-1, -2)
    volume, inverse = torch.linalg.det(rest) / 6, torch.linalg.inv(rest)

    def deformation(at):
        c = at[:, model.tets]
        return (c[:, :, 1:] - c[:, :, :1]).transpose(-1, -2) @ inverse

    f, before = deformation(end), deformation(x)
    strain = torch.linalg.det(f) - 1
    density = mu / 2 * (f.square().sum((-1, -2)) - 3) - mu * strain + (lam + mu) / 2 * strain.square()
    density = density + viscosity * mu / 2 * (f - before).square().sum((-1, -2))
    y = x + h * v + h * h * torch.tensor([0.0, -9.8, 0.0], **f64)
    energy = 0.5 * (model.mass[:, None] * (end - y).square()).sum() + h * h * (volume * density).sum()
    return torch.autograd.grad(energy, end)[0][:, 2:].abs().max().item()


end, _ = dv.step(model, x, v, dv.VBD(h, 800), mu=mu, lam=lam, gravity=gravity)
residual, without = gradient(end, viscosity), gradient(end, 0.0)
print("residual", residual, without)
assert residual <= tolerance("closed_form") * without and without > 0

names = ("x", "v", "mu", "lam", "rest_points")
leaves = [a.clone().requires_grad_() for a in (x, v, mu, lam, model.rest_points)]
for tape in ("full", "compact", "recompute"):
    for sweeps in (1, 3):
        def run(x, v, mu, lam, rest):
            solver = dv.VBD(h, sweeps, tape=tape)
            out = dv.step(model, x, v, solver, mu=mu, lam=lam, rest_points=rest, gravity=gravity)
            return torch.cat([out[0], h * out[1]], -1)

        weights = torch.randn(2, n, 6, **f64)
        bars = torch.autograd.grad((weights * run(*leaves)).sum(), leaves)
        for name, leaf, bar in zip(names, leaves, bars):
            direction = torch.randn_like(leaf) * leaf.abs().mean()
            if name in ("x", "v"):
                direction[:, :2] = 0
            with torch.no_grad():
                def at(s):
                    moved = [a + s * direction if a is leaf else a for a in leaves]
                    return (weights * run(*moved)).sum().item()
                s = 1e-4
                numeric = (8 * (at(s) - at(-s)) - (at(2 * s) - at(-2 * s))) / (12 * s)
            exact = (bar * direction).sum().item()
            error = abs(exact - numeric) / abs(numeric)
            print(tape, sweeps, name, exact, error)
            assert abs(exact) > 0 and error <= tolerance("finite_difference")
print("a law that reads x_prev")
"""


def change_the_law(root: Path) -> None:
    energies = root / "csrc" / "energies"
    (energies / "damped.h").write_text(LAW, encoding="utf-8")
    edit(energies / "tet.h", "bool reads_x_prev = false;", "bool reads_x_prev = true;")
    edit(energies / "energies.h", '#include "stable_neo_hookean.h"', '#include "damped.h"')
    edit(energies / "energies.h", "using TetLaw = StableNeoHookean<true>;", "using TetLaw = Damped<true>;")
    edit(energies / "energies.h", "using Elastic = StableNeoHookean<", "using Elastic = Damped<")


@pytest.mark.slow
@needs_csrc
def test_a_law_that_reads_x_prev(tmp_path: Path) -> None:
    copy_sources(tmp_path)
    change_the_law(tmp_path)
    build(tmp_path)
    assert "a law that reads x_prev" in run(tmp_path, SCRIPT)
