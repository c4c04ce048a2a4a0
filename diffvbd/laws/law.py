"""A law from its energy density: what a Model takes among its energies in place of StableNeoHookean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from .._common.checks import fail, name_value, refuse_gradient
from .._common.constants import EXACT_BLOCK
from .._common.messages import warn
from ..energies import numbers_of
from .density import INVARIANTS, STRETCHES, Density

FIBRE = "a0"
# inputs of a step that mean something else, or that own laws do not have, and other arguments of what takes inputs
TAKEN = {"force", "gravity", "prescribed", "colliders", "colliders_before", "rest_points", "density", "drag", "young",
         "poisson", "stress_free", "viscosity", "volume_viscosity", "below", FIBRE, STRETCHES, "model", "x", "v",
         "solver", "steps", "duration", "adjoint", "history", "save", "observe", "checkpoint_every", "checks",
         "progress", "check_every", "max_sweeps", "max_iterations", "on_failure", "error", "gradient", "quantity",
         "time_budget", "device", "before", "loss", "mesh", "previous", "warn", "fraction",
         "tolerance"}  # fmt: skip
RESIDUAL = 1e-6  # of the moduli: stress of a body at rest from which a law is warned of


class Law:
    """An elastic law from its energy density; see :func:`diffvbd.law`, which makes one.

    Attributes:
        expression: The text of psi.
        values: Its parameters by name, float64 tensors of shape [] or [T].
        a0: Directions of fibres, float64 [3] or [T, 3], or None.
    """

    name: ClassVar[str] = "law"
    bit: ClassVar[int] = EXACT_BLOCK

    def __init__(self, expression: str, values: dict[str, Any], a0: Any = None) -> None:
        self.expression = expression
        self.density = Density(expression)
        names = self.density.parameters
        if wrong := sorted(set(names) & TAKEN):
            fail("expression", "parameters with names of their own", f"{wrong[0]!r}, another argument of a step")
        if missing := sorted(set(names) - set(values)):
            known = ", ".join((*INVARIANTS, STRETCHES))
            fail(missing[0], f"a number or a tensor: {expression!r} has it, and it is none of {known}", "none")
        if unknown := sorted(set(values) - set(names)):
            fail(unknown[0], f"a parameter of {expression!r} ({', '.join(names) or 'none'})", "another name")
        self.values: dict[str, Tensor] = {}
        for name in names:
            refuse_gradient(name, values[name], "pass it to a step or a rollout")
            value = numbers_of(name, values[name]).cpu()
            if value.dim() > 1:
                fail(name, "a number or shape [T]", f"shape {list(value.shape)}")
            self.values[name] = value
        sizes = {name: value.numel() for name, value in self.values.items() if value.numel() != 1}
        if len(set(sizes.values())) > 1:
            fail("parameters", "numbers or one value a tet, as many of each", sizes)
        if (a0 is None) == self.density.fibre:
            fail(FIBRE, "directions of fibres with I4 in the expression, and only then", "none" if a0 is None else a0)
        refuse_gradient(FIBRE, a0, "pass it to a step or a rollout")
        self.a0 = None if a0 is None else numbers_of(FIBRE, a0).cpu()
        if self.a0 is not None and (self.a0.dim() not in (1, 2) or self.a0.shape[-1] != 3):
            fail(FIBRE, "shape [3] or [T, 3]", f"shape {list(self.a0.shape)}")
        if self.a0 is not None:
            check_fibre(self.a0)
        self._check_rest()

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs of a step that are the law's."""
        return (*self.density.parameters, *(() if self.a0 is None else (FIBRE,)))

    def _check_rest(self) -> None:
        """Warns where a body at rest has stress."""
        given = [self.values[p] for p in self.density.parameters]
        self.check_finite(given)
        mu, lam, stress = self.at_rest(given)
        slopes = self._slopes_at_rest()
        size = mu.abs() + lam.abs()
        stress = torch.maximum(stress.abs(), 2 * slopes[3].abs())
        if bool((stress > RESIDUAL * size).any()):
            most = float(stress.abs().max())
            warn(f"law: {self.expression!r} has a stress of {most:.4g} Pa at F = I: the mesh is not its shape at rest")

    def _slopes_at_rest(self) -> list[Tensor]:
        given = [self.values[p] for p in self.density.parameters]
        one = torch.ones((), dtype=torch.float64)
        return self.density.slopes([3 * one, 3 * one, one, one], given)

    def at_rest(self, parameters: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """mu, lam and stress [Pa] at F = I, without fibres, of parameters in their order; differentiable."""
        like = parameters[0] if parameters else torch.zeros((), dtype=torch.float64)
        # numbers are filled in, as nothing may be copied to a device while a CUDA graph is captured
        mu, lam, stress = (m if isinstance(m, Tensor) else like.new_full((), float(m))
                           for m in self.density.at_rest(*parameters))  # fmt: skip
        return mu, lam, stress

    def check_finite(self, parameters: Sequence[Tensor]) -> None:
        """Raises for parameters in their order with which psi at F = I is no number: no step would find its least."""
        one = torch.ones_like(parameters[0]) if parameters else torch.ones((), dtype=torch.float64)
        (psi,) = self.density.value([3 * one, 3 * one, one, one], [p.detach() for p in parameters])
        what = f"parameters with which {self.expression!r} is a finite number [Pa] at F = I"
        name_value("law", what, psi, torch.isfinite(psi))

    def check_mesh(self, num_tets: int) -> None:
        """Raises where the values do not fit a mesh."""
        for name, value in self.values.items():
            if value.shape not in ((), (1,), (num_tets,)):
                fail(name, f"a number or shape [{num_tets}]", f"shape {list(value.shape)}")
        if self.a0 is not None and self.a0.shape not in ((3,), (num_tets, 3)):
            fail(FIBRE, f"shape [3] or [{num_tets}, 3]", f"shape {list(self.a0.shape)}")

    def __getstate__(self) -> tuple[str, dict[str, Tensor], Tensor | None]:
        return self.expression, self.values, self.a0

    def __setstate__(self, state: tuple[str, dict[str, Tensor], Tensor | None]) -> None:
        self.expression, self.values, self.a0 = state
        self.density = Density(self.expression)

    def __repr__(self) -> str:
        given = [f"{k}={float(v):g}" if v.numel() == 1 else f"{k}=[{v.numel()}]" for k, v in self.values.items()]
        return f"law({', '.join([repr(self.expression), *given, *([] if self.a0 is None else ['a0'])])})"


def law(expression: str, *, a0: Any = None, **parameters: Any) -> Law:
    """An elastic law from its energy density psi [Pa] per volume at rest, with everything that a built-in law has.

    Args:
        expression: psi as a formula of the invariants I1 = tr C, I2 = ((tr C)^2 - tr C^2) / 2, J = det F,
            I4 = a0 . C a0 with C = F^T F, of trU, the sum of the principal stretches, of ``log``, ``exp`` and ``sqrt``,
            and of parameters, which are all other names. Where J is below 0.1, psi is continued by its Taylor
            polynomial of second order in J, so that log(J) is defined for tets that are inside out.
        a0: Direction of the fibres at rest, of any length but 0, shape [3] or [T, 3]; with I4.
        **parameters: The value of each parameter, a number or a tensor [T], in any unit. A step takes others as inputs
            of the same names, broadcast to x.shape[:-2] + (T,), which are differentiable, as is ``a0``.

    Returns:
        A Law for ``Model(energies=(law, ...))``. The first Model with it compiles it, half a minute; the object is
        kept for later processes.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came.
        ImportError: Without sympy.

    Source: docs/guides/own-law.md.
    """
    return Law(expression, parameters, a0)


def check_fibre(a0: Tensor) -> None:
    """Raises for directions of length 0."""
    square = a0.detach().square().sum(-1)
    name_value(FIBRE, "directions of finite length > 0", square, (square > 0) & torch.isfinite(square))
