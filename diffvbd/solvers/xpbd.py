"""XPBD of distance constraints, with the exact adjoint of the executed sweeps. Plain torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._common.checks import check_time_step, fail, is_word
from .._common.context import lasting_tensors
from ..mesh import TetMesh
from ..step.arguments import GRAVITY
from .compose import Bars, BlockUpdate, Solver, Tensors, compose
from .particles import ParticleSolver, all_finite, direction_of, dot, mesh_edges, mesh_mass, placed


class Projection(NamedTuple):
    """Intermediate results of an update of n constraints; both of its directions start from them."""

    direction: Tensor  # n [..., n, 3]
    inverse: Tensor  # 1 / |xa - xb| [1/m] [..., n, 1]
    wa: Tensor  # inverse masses [1/kg] [..., n, 1]
    wb: Tensor
    a: Tensor  # compliance over h^2 [1/kg] [..., n, 1]
    scale: Tensor  # 1 / (wa + wb + a) [kg]
    before: Tensor  # multipliers [kg m] [..., n, 1]
    change: Tensor  # dlam


class DistanceProjection(BlockUpdate):
    """Projection of distance constraints that share no particle.

    State: positions x [m] [..., V, 3] and multipliers [kg m] [..., C, 1]. Parameters: inverse masses [1/kg] [..., V],
    compliance over h^2, a = 1 / (k h^2) [1/kg] [..., C], rest lengths L [m] [..., C]. Of a constraint between a and b,
    with n = (xa - xb) / |xa - xb|,

        dlam = -(|xa - xb| - L + a lam) / (wa + wb + a)      xa += wa n dlam      xb -= wb n dlam      lam += dlam

    Where xa = xb there is no direction: n and the derivative of the length are 0, so that only the multiplier changes.

    Args:
        edges: The particles a and b of all constraints, int64 [C, 2].
        constraints: Indices [n] of those to project.

    Source: Macklin, Mueller, Chentanez, "XPBD", Motion in Games, 2016; paper, appendix on other block solvers.
    """

    def __init__(self, edges: Tensor, constraints: Tensor) -> None:
        self.constraints = constraints
        self.a, self.b = edges[constraints].unbind(1)
        self.both = torch.cat((self.a, self.b))
        self.rows = (self.both, constraints)

    def project(self, state: Tensors, parameters: Tensors) -> Projection:
        """The projection at a state; arguments as those of ``update``."""
        x, multipliers = state
        weight, compliance, rest_length = parameters
        direction, inverse, length = direction_of(x[..., self.a, :] - x[..., self.b, :])
        wa, wb = weight[..., self.a, None], weight[..., self.b, None]
        a = compliance[..., self.constraints, None]
        gap = length - rest_length[..., self.constraints, None]
        scale = 1 / (wa + wb + a)
        before = multipliers[..., self.constraints, :]
        return Projection(direction, inverse, wa, wb, a, scale, before, -(gap + a * before) * scale)

    def update(self, state: Tensors, parameters: Tensors) -> Bars:
        p = self.project(state, parameters)
        move = torch.cat((p.wa * p.change * p.direction, -p.wb * p.change * p.direction), -2)
        return state[0][..., self.both, :] + move, p.before + p.change

    def vjp(self, state: Tensors, rows_bar: Bars, parameters: Tensors) -> tuple[Bars, Bars]:
        direction, inverse, wa, wb, a, scale, before, change = self.project(state, parameters)
        x_bar, after_bar = rows_bar
        assert x_bar is not None and after_bar is not None
        a_bar, b_bar = x_bar.split(self.a.numel(), -2)
        along_a, along_b = dot(direction, a_bar), dot(direction, b_bar)
        change_bar = wa * along_a - wb * along_b + after_bar
        per_scale = change_bar * scale  # minus the adjoint of the gap

        # Of the adjoint of the direction only what is across it matters: the direction has length 1.
        direction_bar = change * (wa * a_bar - wb * b_bar)
        across = direction_bar - dot(direction, direction_bar) * direction
        apart_bar = across * inverse - per_scale * direction
        points, constraints = state[0].shape[-2], state[1].shape[-2]
        to_x = placed(torch.cat((a_bar + apart_bar, b_bar - apart_bar), -2), self.both, points)
        to_multipliers = placed(after_bar - a * per_scale, self.constraints, constraints)
        # A weight moves its particle, and makes the correction smaller, for both particles, through scale.
        w_bar = torch.cat(((along_a - per_scale) * change, -(along_b + per_scale) * change), -2)
        # d dlam / da = -(lam + dlam) scale: by the numerator and by scale at once
        compliance_bar = -per_scale * (before + change)
        return (to_x, to_multipliers), (
            placed(w_bar[..., 0], self.both, points, dim=-1),
            placed(compliance_bar[..., 0], self.constraints, constraints, dim=-1),
            placed(per_scale[..., 0], self.constraints, constraints, dim=-1),
        )


class XPBD(ParticleSolver):
    """Particles and distance constraints, solved by K sweeps of projections per step.

    What is given here are constants, no tensors that require grad; what is differentiated is an argument of
    :meth:`step`.

    Args:
        points: Rest positions [m], shape [V, 3], or the number of particles V (steps then need ``rest_length``).
        edges: The two particles of each constraint, integers [C, 2]. Those between two pinned particles are left out
            (their gradients are zero).
        mass: [kg], a number or shape [V], > 0 where not pinned.
        pinned: A bool mask [V] or indices. Pinned particles have inverse mass 0.
        order: "sequential" projects one constraint after another as they are listed; "colored" groups constraints that
            share no particle and projects each group at once: the sequential sweep in the order of the groups.
        dtype, device: torch.float64 or torch.float32; where the constants live.

    Attributes:
        edges: int64 [C, 2].
        rest_length: Distances of the rest positions [m], [C]; None without such.
        groups: The constraints of each update, int64 [n], in order.
        solver: Their composition, see :func:`compose`; state and parameters as in :class:`DistanceProjection`.

    Raises:
        ValueError, TypeError: naming the argument, what was expected and what came.
    """

    @lasting_tensors()
    def __init__(
        self,
        points: Any,
        edges: Any,
        mass: Any,
        pinned: Any = None,
        order: str = "colored",
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(points, mass, edges, pinned, dtype, device)
        if not is_word(order, "sequential", "colored"):
            fail("order", '"sequential" or "colored"', repr(order))
        # Two pinned particles have no weight between them: with infinite stiffness, too, scale would be 1 / 0.
        kept = (~self.pinned[self.edges].all(1)).nonzero()[:, 0]
        listed = [[c] for c in kept.tolist()] if order == "sequential" else _colors(self.edges.tolist(), kept.tolist())
        self.groups = [torch.tensor(group, dtype=torch.int64, device=device) for group in listed]
        self.solver: Solver = compose(DistanceProjection(self.edges, group) for group in self.groups)

    @classmethod
    def from_mesh(
        cls, mesh: TetMesh, density: float = 1000.0, pinned: Any = None, order: str = "colored", **options: Any
    ) -> XPBD:
        """A constraint for each edge of a mesh, masses lumped from its density [kg/m^3]; options: dtype, device.

        Points and density are constants; give ``mass`` to :meth:`step` for its gradient.

        Raises:
            TypeError: mesh is no TetMesh, or density or pinned of a wrong type.
            ValueError: density is not > 0, or pinned, order or an option does not fit.
        """
        mass = mesh_mass(mesh, density)
        return cls(mesh.points, mesh_edges(mesh), mass, pinned, order, **options)

    def step(
        self,
        x: Tensor,
        v: Tensor,
        *,
        stiffness: float | Tensor,
        rest_length: float | Tensor | None = None,
        mass: float | Tensor | None = None,
        time_step: float,
        sweeps: int,
        force: Tensor | None = None,
        gravity: Sequence[float] | Tensor = GRAVITY,
        prescribed: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """One time step: predictor, multipliers from zero, K sweeps, velocity. Differentiable in every tensor argument.

        Args:
            x, v: Positions [m] and velocities [m/s], shape [..., V, 3]; leading dimensions are scenes.
            stiffness: k [N/m] > 0, broadcasts to x.shape[:-2] + (C,); inf is a constraint without compliance.
            rest_length: L [m] >= 0, likewise; None: the distances of the rest positions.
            mass: [kg], broadcasts to x.shape[:-2] + (V,); None: the solver's.
            time_step: h [s] > 0, not differentiable.
            sweeps: K >= 0.
            force: External forces [N], broadcasts to x.shape.
            gravity: Acceleration [m/s^2], 3 numbers, or a tensor that broadcasts to x.shape.
            prescribed: Where pinned particles go [m], broadcasts to x.shape; None: they stay.

        Returns:
            Positions and velocities after the step, shape of x.

        Raises:
            ValueError, TypeError: Naming the argument; values are looked at on the CPU only.
            NotImplementedError: In the backward, for second derivatives.
        """
        y, masses = self.begin(
            x, v, mass=mass, time_step=time_step, force=force, gravity=gravity, prescribed=prescribed
        )
        h, count = check_time_step(time_step, self.mass.dtype), self.edges.shape[0]
        lengths = self.lengths(rest_length, x)
        compliance = 1 / (self.per("stiffness", stiffness, x, count, "> 0") * (h * h))
        if not compliance.is_cuda and not all_finite(compliance):
            fail("stiffness", "numbers for which the compliance 1 / (k h^2) is finite", "NaN or Inf")
        # Pinned particles may have any mass, even 0: chosen before the division, so that no NaN reaches a gradient.
        weight = torch.where(self.pinned, 0.0, 1 / torch.where(self.pinned, 1.0, masses))
        multipliers = y.new_zeros((*x.shape[:-2], count, 1))
        end, _ = self.solver((y, multipliers), (weight, compliance, lengths), sweeps=sweeps)
        return end, (end - x) / h


def _colors(edges: list[list[int]], kept: list[int]) -> list[list[int]]:
    """Greedy coloring: each constraint joins the first group that has neither of its particles."""
    groups: list[list[int]] = []
    used: list[set[int]] = []  # particles of each group
    for c in kept:
        ends = set(edges[c])
        free = next((n for n, taken in enumerate(used) if not taken & ends), len(groups))
        if free == len(groups):
            groups.append([])
            used.append(set())
        groups[free].append(c)
        used[free] |= ends
    return groups
