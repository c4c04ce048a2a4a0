"""System: a Model and a solver together, and what follows from the two. The package works on it; users never see it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import torch

from .. import ops
from .._common.checks import check_kind, check_positive, fail
from .._common.constants import CONTACT, ELASTIC, EXACT_BLOCK, FILTER_ETA, PAPER_BLOCK, SATURATION_EPS
from .._common.context import not_compiled
from .._contact.surface import ContactSurface
from ..ops import regimes
from .coarse import check_coupled, plan_of
from .material import lumped_mass, rest_metric
from .model import Model
from .moving import moving_bodies
from .solver import VBD


class System(Model):
    """A Model with the attributes that a solver decides; it shares all tensors of the Model.

    Attributes:
        model: The Model.
        solver: A solver of this key; its time step, sweeps, integrator and tape play no part.
        rigid: Whether free bodies have a rigid correction.
        corrects: Whether there is such a body.
        starts_from: Start of the sweeps of bodies that are not corrected; "auto" only where there is a choice.
    """

    def __init__(self, model: Model, solver: VBD) -> None:
        self.__dict__.update({name: value for name, value in vars(model).items() if name != "surface_of_contact"})
        self.model, self.solver, self._derived = model, solver, {}
        self.relaxation, self.start, self.block = solver.relaxation, solver.start, solver.block
        self.saturation, self.regularization, self.coarse = solver.saturation, solver.regularization, solver.coarse
        self.rigid = self.may_correct and solver.subspace is not None
        self._check()
        if solver.block == "paper" and self.energy_mask & EXACT_BLOCK:
            self.energy_mask ^= EXACT_BLOCK | PAPER_BLOCK
        if self.rigid != self.may_correct:
            arrays = torch.from_numpy(self.mesh.points.copy()), self._topology[0].cpu(), self._pinned.cpu()
            bodies, others = self._find_bodies(*arrays, self.rigid)
            self._bodies, self._other_bodies = bodies.to(self.device), others.to(self.device)
        if self.coarse is not None:
            self._arrange_coarse()
        self.corrects = self._bodies.number > 0
        self.starts_from = self._start()

    def _start(self) -> str:
        if self.start != "auto" or self.coarse is not None:  # corrections do what the predictor is for
            return "inertia" if self.start == "auto" else self.start
        # with pairs a step decides it itself, by gravity alone
        return "predictor" if self.contact is not None or not self._other_bodies.number else "auto"

    def _check(self) -> None:
        """Raises where a solver does not suit the Model."""
        for name, unit in (("saturation", "m"), ("regularization", "kg")):
            if getattr(self, name):  # in the Model's dtype, of which the solver knows nothing
                check_positive(name, getattr(self, name), unit, self.dtype)
        if self.start == "inertia" and self.contact is not None:
            fail("start", '"auto" or "predictor" with a PairBarrier, whose steps approach y in substeps', '"inertia"')
        if self.rigid_bodies is not None and self.solver.subspace is None:
            fail("subspace", '"rigid" or "coarse" with rigid bodies', "None")
        if self.law is not None and self.block == "paper":
            fail("block", '"exact" with a law of your own', '"paper"')
        if self.coarse is None:
            return
        if not self.energy_mask & ELASTIC:
            fail("subspace", "no coarse space without StableNeoHookean", repr(self.coarse))

    @not_compiled
    def _arrange_coarse(self) -> None:
        """The coarse space, in float64, on the CPU, then placed."""
        assert self.coarse is not None
        points = torch.from_numpy(self.mesh.points.copy())
        tets, *star = (t.cpu() for t in self._topology)
        pinned, device = self._unswept.cpu(), self.device
        rest, volume = rest_metric(ops.tet_gather(points[None], tets, *star))
        mass = lumped_mass(self._density.cpu().double()[None], volume, tets, *star)[0]
        given = (points, tets, pinned, mass, rest, self._plan.cpu())
        self.coarse_geometry, plan = plan_of(self.coarse, *given, device.type, None if self.touches else self.joined)
        check_coupled(self.coarse_geometry, self.touches)
        self._coarse_plan = plan.to(device, self.dtype)
        if self.touches and self.contact is None:  # with pairs the Model has them
            moving = moving_bodies(points, tets, pinned, bool(self.energy_mask & ELASTIC))
            self._moving = moving.to(device, self.dtype)

    @property
    def corrects_each_sweep(self) -> bool:
        """Whether couplings may pull together free bodies that no coarse correction moves."""
        return bool(self.couplings) and self.corrects and (self.coarse is None or self.rigid_bodies is not None)

    @property
    def surface_of_contact(self) -> ContactSurface | None:  # the Model may replace it, with room for more pairs
        return self.model.surface_of_contact

    @property
    def rest_scalars(self) -> torch.Tensor:
        return self.model.rest_scalars

    def with_solver(self, **changes: Any) -> System:
        """The same Model with other arguments of its solver."""
        return system_of(self.model, replace(self.solver, **changes))

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> System:
        return system_of(self.model.to(device, dtype), self.solver)

    def _on_cpu(self) -> System:
        """The same System on the CPU: what debug_checks() asks about a step on CUDA."""
        return self.derived("on_cpu", lambda: self.to("cpu"))

    def launch(self, scenes: int) -> tuple[int, int, int, int]:
        """How the sweeps of so many scenes are spread over a CUDA device."""
        touches, together = bool(self.energy_mask & CONTACT), self.coarse is not None or self.law is not None
        return regimes.choose(self.num_vertices, self.num_colors, scenes, touches, together)

    def settings(self, time_step: float, sweeps: int, scenes: int = 1) -> ops.SweepSettings:
        """Settings of the kernels; ``scenes`` chooses the regime on CUDA."""
        saturation = -1.0 if self.saturation is None else self.saturation
        # a lone over-relaxed sweep would leave the correction a shape that the next step starts wrong from
        last = min(self.relaxation, 1.0) if self.corrects or self.coarse is not None else self.relaxation
        friction_eps = 1.0 if self.friction is None else time_step * self.friction.velocity
        numbers = ops.StepNumbers(time_step, self.regularization, self.relaxation, saturation, SATURATION_EPS,
                                  FILTER_ETA, last, friction_eps)  # fmt: skip
        coarse = self._coarse_plan.sizes if self.coarse is not None else ()
        launch = self.launch(scenes) if self.device.type == "cuda" else ()
        return ops.SweepSettings(self._sizes, self.energy_mask, self._data_count, numbers, sweeps, launch, coarse)


def system_of(model: Model, solver: VBD) -> System:
    """The System of a Model and a solver, built at its first use and kept with the Model."""
    check_kind("model", model, Model)
    check_kind("solver", solver, VBD)
    model = model.model if isinstance(model, System) else model
    return model.derived(solver.key, partial(System, model, solver))


Model._executed_by = system_of  # for the reference, which imports nothing of the package
