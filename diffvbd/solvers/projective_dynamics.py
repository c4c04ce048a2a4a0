"""Projective dynamics of springs and tets, with the exact adjoint of the executed iterations. Plain torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor

from .._common.checks import check_time_step, fail
from .._common.context import lasting_tensors
from ..mesh import TetMesh
from ..ops.sums import one_thread
from ..step.arguments import GRAVITY
from .compose import Bars, BlockUpdate, Solver, Tensors, compose
from .particles import ParticleSolver, Springs, Tets, all_finite, mesh_edges, mesh_mass, placed

MAX_FREE = 4096  # free particles of one dense factor: 128 MiB in float64


class Given(NamedTuple):
    """A tensor that a factor was made of, and what it was at that time."""

    name: str
    tensor: Tensor
    version: int | None  # None: an inference tensor, of which torch counts none
    values: Tensor

    def moved(self) -> bool:
        """True if it was changed in place since. Fused optimizers, ``.data`` and inference tensors leave the version
        as it was; values tell on the CPU, on CUDA a look at them would wait for the device."""
        if self.version is not None and self.tensor._version != self.version:
            return True
        now = self.tensor.detach()
        return not now.is_cuda and not torch.allclose(now, self.values, rtol=0, atol=0, equal_nan=True)


@dataclass(frozen=True, eq=False)
class Factor:
    """The factored matrix of a :class:`ProjectiveDynamics` and what it was made of: made once, used in every step.

    A step raises once a tensor that was given to ``factor`` has been changed in place, as an optimizer does: the matrix
    is that of the old values. Where that cannot be told (on CUDA, for a change that torch does not count) the step is
    that of the old values throughout, and so is its gradient.

    Attributes:
        lower: Cholesky factor of the matrix of the n free particles [kg], shape [..., n, n], detached.
        time_step: h [s].
        stiffness: Of the springs [N/m], [..., C]; tet_stiffness: of the tets [Pa], [..., T]; mass: [kg], [..., V].
            Copies of what was given to ``factor``, broadcast; gradients reach what was given.
        network: What made the factor, and alone can step with it.
        solver: The iteration with this matrix, see :class:`LocalGlobal` for its state and parameters.
        given: The tensors that were given, to tell whether they have changed.
    """

    lower: Tensor
    time_step: float
    stiffness: Tensor
    tet_stiffness: Tensor
    mass: Tensor
    network: ProjectiveDynamics
    solver: Solver
    given: tuple[Given, ...]

    def check(self) -> None:
        """Raises ValueError where a tensor has changed since it was factored."""
        for one in self.given:
            if one.moved():
                fail(one.name, "the values that were factored", "a tensor changed in place since; factor again")


class LocalGlobal(BlockUpdate):
    """One iteration: project every constraint, then solve for all free particles with a constant matrix A.

    State: (x,), positions [m], [..., V, 3]. Parameters: predictor y [m] [..., V, 3], masses [kg] [..., V], spring
    stiffness [N/m] and rest lengths [m] [..., C], tet stiffness [Pa] [..., T]. With S the measures, P the projections
    and w the weights,

        g(x) = M (x - y) + h^2 S^T w (S x - P(S x))          x <- x - A^-1 g(x),   A = M + h^2 S^T w S

    on the free particles: paper eq. 3 with one block and a block Hessian that does not depend on the state.

    Args:
        network: Whose springs and tets these are.
        lower: Cholesky factor of A [kg] for the free particles, shape [..., n, n].
        time_step: h [s].

    Source: Bouaziz et al., "Projective Dynamics", ACM TOG 33(4), 2014; paper, appendix on other block solvers.
    """

    def __init__(self, network: ProjectiveDynamics, lower: Tensor, time_step: float) -> None:
        self.lower, self.scale = lower, time_step**2
        self.free, self.springs, self.tets = network.free, network.springs, network.tets
        self.rows = (self.free,)

    def _forces(self, x: Tensor, y: Tensor, mass: Tensor, k: Tensor, length: Tensor, w: Tensor) -> Tensor:
        # As differences S x - P(S x), which are strains: S^T w S x alone would cancel against S^T w P(S x).
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
        # Made again and not kept: the tape holds the old rows only, and one more solve with a factor is cheap.
        (rows,) = self.update(state, parameters)
        assert rows is not None
        new = x.clone()
        new[..., self.free, :] = rows
        p = placed(_solve(self.lower, out_bar), self.free, size)

        d, p_d = self.springs.measure(x), self.springs.measure(p)
        # A changes with the weights, too: by A x' = b they multiply S x' - P(S x), of the new and of the old state.
        stretch = self.springs.measure(new) - self.springs.project(d, length)
        k_bar = -self.scale * (p_d * stretch).sum(-1)
        d_bar, length_bar = self.springs.project_vjp(d, length, self.scale * k[..., None] * p_d)
        w = (stiffness * self.tets.volume)[..., None, None]
        f, p_f = self.tets.measure(x), self.tets.measure(p)
        stretch = self.tets.measure(new) - self.tets.project(f)
        stiffness_bar = -self.scale * self.tets.volume * (p_f * stretch).sum((-1, -2))
        f_bar = self.tets.project_vjp(f, self.scale * w * p_f)

        # Pinned particles stand on the right-hand side with their own columns of A.
        from_pinned = self.springs.transpose(k[..., None] * p_d) + self.tets.transpose(w * p_f)
        from_pinned[..., self.free, :] = 0
        x_bar = self.springs.transpose(d_bar) + self.tets.transpose(f_bar) - self.scale * from_pinned
        mass_bar = -(p * (new - y)).sum(-1)
        return (x_bar,), (mass[..., None] * p, mass_bar, k_bar, length_bar, stiffness_bar)


class ProjectiveDynamics(ParticleSolver):
    """Particles with springs and tets, solved by K local-global iterations per step.

    What is given here are constants, as in :class:`XPBD`; what is differentiated is an argument of :meth:`step` or
    :meth:`factor`.

    Args:
        points, mass, pinned, dtype, device: As in :class:`XPBD`; with tets, ``points`` are rest positions.
        edges: The two particles of each spring, integers [C, 2]; None: no springs.
        tets: The corners of each tet, integers [T, 4], of positive volume at ``points``; None: no tets.

    Attributes:
        edges: int64 [C, 2]. rest_length: Distances of the rest positions [m], [C]; None without such.
        springs, tets: The two kinds of constraints, see :class:`.projections.Springs` and :class:`.projections.Tets`.
        free: Indices of the particles that are not pinned, int64 [n].

    Raises:
        ValueError, TypeError: naming the argument; more than ``MAX_FREE`` free particles, because the factor is dense.
    """

    @lasting_tensors()
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
        super().__init__(points, mass, [] if edges is None else edges, pinned, dtype, device)
        self.free = (~self.pinned).nonzero()[:, 0]
        if self.free.numel() > MAX_FREE:
            fail("points", f"at most {MAX_FREE} free particles (the factor is dense)", self.free.numel())
        self.springs = Springs(self.edges, self.num_points)
        corners = torch.zeros((0, 4), dtype=torch.int64, device="cpu")
        rest_points = torch.zeros((self.num_points, 3), dtype=dtype, device="cpu")
        if tets is not None:
            if self.rest_points is None:
                fail("points", "rest positions, because there are tets", "a number of particles")
            # A mesh checks the corners and that no volume is zero or negative, where F and w would be worthless.
            rest_points = self.rest_points.cpu()
            corners = torch.from_numpy(TetMesh(rest_points, tets).tets.copy())
        self.tets = Tets(corners.to(device), rest_points.to(device))

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
        """Springs along the edges of a mesh, its tets, or both; otherwise as :meth:`XPBD.from_mesh`.

        Raises:
            TypeError, ValueError: As :meth:`XPBD.from_mesh`; ValueError also where too many particles are free.
        """
        mass, edges = mesh_mass(mesh, density), mesh_edges(mesh) if springs else None
        return cls(mesh.points, mass, edges, mesh.tets if tets else None, pinned, **options)

    def factor(
        self,
        *,
        time_step: float,
        stiffness: float | Tensor | None = None,
        tet_stiffness: float | Tensor | None = None,
        mass: float | Tensor | None = None,
    ) -> Factor:
        """Factors the constant matrix; :meth:`step` takes the factor in place of these arguments.

        Values per scene (with leading dimensions) make a factor per scene.

        Args:
            time_step: h [s] > 0, not differentiable.
            stiffness: k [N/m] >= 0, a number or shape [..., C]; None without springs.
            tet_stiffness: [Pa] >= 0, a number or shape [..., T]; None without tets.
            mass: [kg] > 0 where not pinned, a number or shape [..., V]; None: the solver's.

        Raises:
            ValueError: An argument is missing, given without such constraints, of a wrong shape or (looked at on the
                CPU only) out of its range; or the matrix is not positive definite, because masses are lost in the
                rounding of h^2 times stiffness.
            TypeError: An argument is no number, or a tensor of another dtype than the solver's.
        """
        h = check_time_step(time_step, self.mass.dtype)
        given = (("stiffness", stiffness, self.edges.shape[0], ">= 0"),
                 ("tet_stiffness", tet_stiffness, self.tets.nodes.shape[0], ">= 0"),
                 ("mass", self.mass if mass is None else mass, self.num_points, ""))  # fmt: skip
        values, tensors = [], []
        for name, original, count, least in given:
            if original is None and count:
                fail(name, "a value (the solver has such constraints)", None)
            if original is not None and not count and name != "mass":
                fail(name, "None (the solver has no such constraints)", original)
            value = self.tensor(name, 0.0 if original is None else original)
            if value.dim() and value.shape[-1] not in (1, count):
                fail(name, f"a shape that broadcasts to [..., {count}]", f"shape {list(value.shape)}")
            # A copy, so that no step can mix the matrix of these values with later ones; gradients pass through it.
            kept = value.clone()
            if isinstance(original, Tensor):
                version = None if original.is_inference() else original._version
                tensors.append(Given(name, original, version, kept.detach()))
            values.append(self.per(name, kept, value.new_empty((*value.shape[:-1], 1, 3)), count, least))
        k, stiff, masses = values
        if mass is not None and not masses.is_cuda:
            self._check_mass(masses.detach())
        # No graph: the vjp of an iteration has the derivative of the matrix, and never forms that of its factor.
        with torch.no_grad():
            matrix = h * h * (self.springs.matrix(k) + self.tets.matrix(stiff * self.tets.volume))
            matrix = matrix[..., self.free[:, None], self.free] + torch.diag_embed(masses[..., self.free])
            with one_thread(matrix):
                lower, failed = torch.linalg.cholesky_ex(matrix)
            if bool(failed.any()) or not (lower.is_cuda or all_finite(lower)):
                self._fail_scale(h, k, stiff, masses)
        # Here and not in each step: compose looks at the rows, for which it waits on CUDA.
        solver = compose([LocalGlobal(self, lower, h)])
        return Factor(lower, h, k, stiff, masses, self, solver, tuple(tensors))

    def _fail_scale(self, h: float, k: Tensor, stiff: Tensor, masses: Tensor) -> NoReturn:
        """Names the arguments of a matrix that is not positive definite in its dtype."""
        stiffest = [(n, float(t.max())) for n, t in (("stiffness", k), ("tet_stiffness", stiff)) if t.numel()]
        names, got = zip(*stiffest, ("mass", float(masses[..., self.free].min())), ("time_step", h), strict=True)
        fail(", ".join(names), f"masses of the scale of h^2 times stiffness (a positive definite matrix in {k.dtype})",
             ", ".join(f"{value:g}" for value in got))  # fmt: skip

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
            x, v, mass, force, gravity, prescribed, sweeps: As in :meth:`XPBD.step`.
            factor: What :meth:`factor` made of time_step, stiffness, tet_stiffness and mass, which are then not given
                here. None: they are, and this step factors the matrix.
            time_step, stiffness, tet_stiffness: As in :meth:`factor`, with the scenes of x.
            rest_length: L [m] >= 0, broadcasts to x.shape[:-2] + (C,); None: the distances of the rest positions.

        Returns:
            Positions and velocities after the step, shape of x.

        Raises:
            ValueError, TypeError, NotImplementedError: As in :meth:`XPBD.step`; ValueError also for a factor of values
                that have been changed in place since.
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
        elif factor.network is not self:
            fail("factor", "one that this solver has made", "one of another solver")
        factor.check()
        h = factor.time_step
        y, masses = self.begin(x, v, mass=factor.mass, time_step=h, force=force, gravity=gravity, prescribed=prescribed)
        # A factor of one scene serves a batch; one per scene must fit the batch that it meets here.
        k = self.per("stiffness", factor.stiffness, x, self.edges.shape[0])
        stiff = self.per("tet_stiffness", factor.tet_stiffness, x, self.tets.nodes.shape[0])
        parameters = (y, masses, k, self.lengths(rest_length, x), stiff)
        (end,) = factor.solver((y,), parameters, sweeps=sweeps)
        return end, (end - x) / h


def _solve(lower: Tensor, rhs: Tensor) -> Tensor:
    """A^-1 rhs for rhs [..., n, 3]; scenes that share a factor are columns of one solve."""
    with one_thread(lower):
        if lower.dim() > 2:
            return torch.cholesky_solve(rhs, lower)
        # By hand, because broadcasting would copy the factor for each scene.
        columns = rhs.movedim(-2, 0)
        return torch.cholesky_solve(columns.flatten(1), lower).reshape(columns.shape).movedim(0, -2)
