"""Projective dynamics of springs and tets, with the exact adjoint of the executed iterations. Plain torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..checks import check_positive, fail
from ..mesh import TetMesh
from .compose import Bars, BlockUpdate, Tensors, compose
from .particles import GRAVITY, ParticleSolver, checked_edges, checked_mesh, mesh_edges, mesh_mass
from .projections import Springs, Tets
from .sums import placed

MAX_FREE = 4096  # free particles of one dense factor: 128 MiB in float64


@dataclass(frozen=True)
class Factor:
    """The factored matrix of a :class:`ProjectiveDynamics` and what it was made of: made once, used in every step.

    Attributes:
        lower: Cholesky factor of the matrix of the free particles, shape [..., n, n], detached.
        time_step: h [s]; stiffness, tet_stiffness, mass: as given to ``factor``, broadcast; gradients reach them.
    """

    lower: Tensor
    time_step: float
    stiffness: Tensor
    tet_stiffness: Tensor
    mass: Tensor


class LocalGlobal(BlockUpdate):
    """One iteration: project every constraint, then solve for all free particles with a constant matrix A.

    State: (x,), positions [m], [..., V, 3]. Parameters: predictor y [m] [..., V, 3], masses [kg] [..., V], spring
    stiffness [N/m] and rest lengths [m] [..., C], tet stiffness [Pa] [..., T]. With S the measures, P the projections
    and w the weights,

        g(x) = M (x - y) + h^2 S^T w (S x - P(S x))          x <- x - A^-1 g(x),   A = M + h^2 S^T w S

    on the free particles: paper eq. 3 with one block and a block Hessian that does not depend on the state.

    Source: Bouaziz et al., "Projective Dynamics", ACM TOG 33(4), 2014; paper, appendix on other block solvers.
    """

    def __init__(self, solver: ProjectiveDynamics, factor: Factor) -> None:
        self.free, self.springs, self.tets = solver.free, solver.springs, solver.tets
        self.lower, self.scale = factor.lower, factor.time_step**2
        self.rows = (self.free,)

    def _forces(self, x: Tensor, y: Tensor, mass: Tensor, k: Tensor, length: Tensor, w: Tensor) -> Tensor:
        d, f = self.springs.measure(x), self.tets.measure(x)
        out = self.springs.transpose(k[..., None] * (d - self.springs.project(d, length)))
        out = out + self.tets.transpose(w[..., None, None] * (f - self.tets.project(f)))
        return mass[..., None] * (x - y) + self.scale * out

    def update(self, state: Tensors, parameters: Tensors) -> Bars:
        (x,) = state
        y, mass, k, length, stiffness = parameters
        g = self._forces(x, y, mass, k, length, stiffness * self.tets.volume)
        return (x[..., self.free, :] - _solve(self.lower, g[..., self.free, :]),)

    def vjp(self, state: Tensors, rows_bar: Bars, parameters: Tensors) -> tuple[Bars, Bars]:
        """p = A^-1 x_bar with the same factor; each adjoint is minus the gradient of p . (A x' - b), x' the new state.

        The identity branch and the part of g that is linear in x cancel: x' depends on the free x through P alone.
        """
        (x,), (out_bar,) = state, rows_bar
        y, mass, k, length, stiffness = parameters
        assert out_bar is not None
        size = x.shape[-2]
        (rows,) = self.update(state, parameters)
        assert rows is not None
        new = x.clone()
        new[..., self.free, :] = rows
        p = placed(_solve(self.lower, out_bar), self.free, size)

        d, p_d = self.springs.measure(x), self.springs.measure(p)
        stretch = self.springs.measure(new) - self.springs.project(d, length)
        k_bar = -self.scale * (p_d * stretch).sum(-1)
        d_bar, length_bar = self.springs.project_vjp(d, length, self.scale * k[..., None] * p_d)
        w = (stiffness * self.tets.volume)[..., None, None]
        f, p_f = self.tets.measure(x), self.tets.measure(p)
        stretch = self.tets.measure(new) - self.tets.project(f)
        stiffness_bar = -self.scale * self.tets.volume * (p_f * stretch).sum((-1, -2))
        f_bar = self.tets.project_vjp(f, self.scale * w * p_f)

        # Pinned particles stand on the right-hand side with their own columns of A.
        held = self.springs.transpose(k[..., None] * p_d) + self.tets.transpose(w * p_f)
        held[..., self.free, :] = 0
        x_bar = self.springs.transpose(d_bar) + self.tets.transpose(f_bar) - self.scale * held
        mass_bar = -(p * (new - y)).sum(-1)
        return (x_bar,), (mass[..., None] * p, mass_bar, k_bar, length_bar, stiffness_bar)


class ProjectiveDynamics(ParticleSolver):
    """Particles with springs and tets, solved by K local-global iterations per step.

    Args:
        points: Rest positions [m], shape [V, 3]; the number of particles V is enough without tets.
        mass: [kg], a number or shape [V], > 0 where not pinned.
        edges: The two particles of each spring, integers [C, 2]; None: no springs.
        tets: The corners of each tet, integers [T, 4], of positive volume at ``points``; None: no tets.
        pinned: A bool mask [V] or indices.
        dtype, device: torch.float64 or torch.float32; where the constants live.

    Raises:
        ValueError, TypeError: naming the argument; more than ``MAX_FREE`` free particles, because the factor is dense.
    """

    def __init__(
        self,
        points: Any,
        mass: Any,
        edges: Any = None,
        tets: Any = None,
        pinned: Any = None,
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(points, mass, pinned, dtype=dtype, device=device)
        self.free = (~self.pinned).nonzero()[:, 0]
        if self.free.numel() > MAX_FREE:
            fail("points", f"at most {MAX_FREE} free particles (the factor is dense)", self.free.numel())
        self.edges = checked_edges([] if edges is None else edges, self.num_points, device)
        self.rest_length: Tensor | None = None
        if self.rest_points is not None:
            ends = self.rest_points[self.edges]
            self.rest_length = torch.linalg.vector_norm(ends[:, 0] - ends[:, 1], dim=-1)
        self.springs = Springs(self.edges, self.num_points)
        corners = torch.zeros((0, 4), dtype=torch.int64)
        rest = torch.zeros((self.num_points, 3), dtype=dtype)
        if tets is not None:
            if self.rest_points is None:
                fail("points", "rest positions, because there are tets", "a number of particles")
            rest = self.rest_points.cpu()
            mesh = TetMesh(rest, tets)
            corners = torch.from_numpy(mesh.tets.copy())
        self.tets = Tets(corners.to(device), rest.to(device))

    @classmethod
    def from_mesh(
        cls,
        mesh: TetMesh,
        density: float = 1000.0,
        pinned: Any = None,
        *,
        springs: bool = False,
        tets: bool = True,
        **options: Any,
    ) -> ProjectiveDynamics:
        """Springs along the edges of a mesh, its tets, or both; density [kg/m^3], lumped; options: dtype, device."""
        mesh = checked_mesh(mesh)
        edges = mesh_edges(mesh) if springs else None
        corners = mesh.tets if tets else None
        return cls(mesh.points, mesh_mass(mesh, density), edges, corners, pinned, **options)

    def factor(
        self,
        *,
        time_step: float,
        stiffness: float | Tensor | None = None,
        tet_stiffness: float | Tensor | None = None,
        mass: float | Tensor | None = None,
    ) -> Factor:
        """Factors the constant matrix; arguments as in :meth:`step`, which then takes ``factor`` in their place.

        Values per scene ([..., C], [..., T] or [..., V] with leading dimensions) make a factor per scene.
        """
        h = check_positive("time_step", time_step, "s")
        given = (("stiffness", stiffness, self.edges.shape[0], ">= 0"),
                 ("tet_stiffness", tet_stiffness, self.tets.nodes.shape[0], ">= 0"),
                 ("mass", self.mass if mass is None else mass, self.num_points, ""))  # fmt: skip
        values = []
        for name, value, count, least in given:
            if value is None and count:
                fail(name, "a value (the solver has such constraints)", None)
            if value is not None and not count and name != "mass":
                fail(name, "None (the solver has no such constraints)", value)
            value = self.tensor(name, 0.0 if value is None else value)
            if value.dim() and value.shape[-1] not in (1, count):
                fail(name, f"a shape that broadcasts to [..., {count}]", f"shape {list(value.shape)}")
            values.append(self.per(name, value, value.new_empty((*value.shape[:-1], 1, 3)), count, least))
        k, stiff, masses = values
        if mass is not None and not masses.is_cuda:
            self._check_mass(masses.detach())
        with torch.no_grad():
            matrix = h * h * (self.springs.matrix(k) + self.tets.matrix(stiff * self.tets.volume))
            matrix = matrix[..., self.free[:, None], self.free] + torch.diag_embed(masses[..., self.free])
            lower = torch.linalg.cholesky(matrix)
        return Factor(lower, h, k, stiff, masses)

    def step(
        self,
        x: Tensor,
        v: Tensor,
        *,
        sweeps: int,
        factor: Factor | None = None,
        time_step: float | None = None,
        stiffness: float | Tensor | None = None,
        tet_stiffness: float | Tensor | None = None,
        rest_length: float | Tensor | None = None,
        mass: float | Tensor | None = None,
        force: Tensor | None = None,
        gravity: Sequence[float] | Tensor = GRAVITY,
        prescribed: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """One time step: predictor, K iterations from it, velocity. Differentiable in every tensor argument.

        Args:
            x, v: Positions [m] and velocities [m/s], shape [..., V, 3]; leading dimensions are scenes.
            sweeps: K >= 0.
            factor: What :meth:`factor` made of time_step, stiffness, tet_stiffness and mass, which are then not given
                here. None: they are, and this step factors the matrix.
            time_step: h [s] > 0.
            stiffness: k [N/m] >= 0 of the springs, broadcasts to x.shape[:-2] + (C,).
            tet_stiffness: [Pa] >= 0; weight over volume of the tets, broadcasts to x.shape[:-2] + (T,).
            rest_length: L [m] >= 0, broadcasts to x.shape[:-2] + (C,); None: the distances of the rest positions.
            mass: [kg], broadcasts to x.shape[:-2] + (V,); None: the solver's.
            force: External forces [N], broadcasts to x.shape.
            gravity: Acceleration [m/s^2], 3 numbers, or a tensor that broadcasts to x.shape.
            prescribed: Where pinned particles go [m], broadcasts to x.shape; None: they stay.

        Returns:
            Positions and velocities after the step, shape of x.

        Raises:
            ValueError, TypeError: Naming the argument; values are looked at on the CPU only.
            NotImplementedError: In the backward, for second derivatives.
        """
        own = {"time_step": time_step, "stiffness": stiffness, "tet_stiffness": tet_stiffness, "mass": mass}
        if factor is None:
            if time_step is None:
                fail("time_step", "a number of seconds, or a factor", None)
            factor = self.factor(time_step=time_step, stiffness=stiffness, tet_stiffness=tet_stiffness, mass=mass)
        elif not isinstance(factor, Factor):
            raise TypeError(f"factor: expected what ProjectiveDynamics.factor returns, got {type(factor).__name__}")
        elif given := [name for name, value in own.items() if value is not None]:
            fail(given[0], "None, because factor has it", own[given[0]])
        h, count = factor.time_step, self.edges.shape[0]
        y, masses = self.begin(x, v, mass=factor.mass, time_step=h, force=force, gravity=gravity, prescribed=prescribed)
        k = self.per("stiffness", factor.stiffness, x, count)
        stiff = self.per("tet_stiffness", factor.tet_stiffness, x, self.tets.nodes.shape[0])
        if rest_length is None:
            if self.rest_length is None and count:
                fail("rest_length", "a value, because the solver was made without rest positions", None)
            rest_length = x.new_zeros(0) if self.rest_length is None else self.rest_length
        lengths = self.per("rest_length", rest_length, x, count, ">= 0")
        solver = compose([LocalGlobal(self, factor)])
        (end,) = solver((y,), (y, masses, k, lengths, stiff), sweeps=sweeps)
        return end, (end - x) / h


def _solve(lower: Tensor, rhs: Tensor) -> Tensor:
    """A^-1 rhs for rhs [..., n, 3]; scenes that share a factor are columns of one solve."""
    if lower.dim() > 2:
        return torch.cholesky_solve(rhs, lower)
    columns = rhs.movedim(-2, 0)
    return torch.cholesky_solve(columns.flatten(1), lower).reshape(columns.shape).movedim(0, -2)
