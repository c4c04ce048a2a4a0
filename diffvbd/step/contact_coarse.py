"""The coarse correction of bodies that touch (docs/method.md, section 16): one Newton step of the incremental potential
in the coarse functions of all bodies of a scene, with their pairs, friction and vertex energies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from ..adjoint.contact import sum_of_scenes
from ..model.system import System
from ..ops.contact import adjoints_of
from ..ops.sums import one_thread
from .contact_rigid import bodies_of, listed_of


class CoarseIndex(NamedTuple):
    """The coarse functions of a Model by vertex, by function and by body, in the order of DIFFVBD_SPACE_FIELDS;
    constants, int32 but for weight, tets and star_ptr."""

    vertex_ptr: Tensor  # [V + 1] entries of a vertex
    function: Tensor  # [entries]
    weight: Tensor  # [entries]
    function_ptr: Tensor  # [F + 1]
    entry: Tensor  # [entries] of a function
    vertex: Tensor  # [entries]
    own: Tensor  # [F, 4] body, the first function of the matrix and their end, cells of matrices before
    body_ptr: Tensor  # [bodies + 1] functions of a body of the mesh
    body_function: Tensor  # [F]
    tets: Tensor  # of Model._topology, as are the next two
    star_ptr: Tensor
    star: Tensor


class _Space(NamedTuple):
    """What the operators read of a Model."""

    functions: CoarseIndex
    bodies: tuple[Tensor, ...]  # order to body of ops.TouchingFields; free: bodies with a vertex that moves
    of_matrix: Tensor  # int64, the body of each matrix


def _space(model: System) -> _Space:
    g, device = model.coarse_geometry, model.device
    body, pinned = model.body.cpu().numpy(), model._pinned.cpu().numpy()
    counts = np.diff(g.function_ptr)
    matrix = np.repeat(np.arange(g.bodies), counts)
    of_matrix = np.zeros(g.bodies, dtype=np.int64)
    of_matrix[matrix[g.function]] = body[g.vertex]
    of_function = of_matrix[matrix]
    cells = np.concatenate(([0], np.cumsum(counts**2)))
    own = np.stack([of_function, g.function_ptr[:-1][matrix], g.function_ptr[1:][matrix], cells[:-1][matrix]], 1)
    number = model.mesh.num_bodies

    def by(label: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        order = np.argsort(label, kind="stable")
        return np.searchsorted(label[order], np.arange(count + 1)), order

    arrays = (by(g.vertex, model.num_vertices)[0], g.function, *by(g.function, g.functions), g.vertex, own,
              *by(of_function, number))  # fmt: skip
    ptr, function, *rest = [torch.from_numpy(np.ascontiguousarray(a, dtype=np.int32)).to(device) for a in arrays]
    weight = torch.from_numpy(g.weight).to(device, model.dtype)
    moves = torch.from_numpy(np.bincount(body[~pinned], minlength=number) > 0).to(device)
    order, body_ptr, _, *labels = bodies_of(model)
    index = CoarseIndex(ptr, function, weight, *rest, *model._topology)
    return _Space(index, (order, body_ptr, moves, *labels), torch.from_numpy(of_matrix).to(device))


class Corrections:
    """The corrections of one substep.

    Args:
        model, fields: Of the step, before its sweeps.
        touching: Pairs, planes and trust regions of the sweeps.
        packed: Matrices of all bodies without vertex energies and pairs, differentiable.
        settings: Of the sweeps.
    """

    def __init__(self, model: System, fields: ops.SweepFields, touching: ops.TouchingFields, packed: Tensor,
                 settings: ops.SweepSettings) -> None:  # fmt: skip
        self.space = model.derived("contact_space", lambda: _space(model))
        at = touching._fields.index("order")
        self.touching = [t.contiguous() for t in (*touching[:at], *self.space.bodies, *touching[at + 5 :])]
        rest = model.rest_scalars if fields.rest is None else fields.rest
        self.rest = [t.contiguous() for t in (fields.mu, fields.lam, rest, packed)]
        options = (model._data_count, settings.numbers.time_step, settings.numbers.friction_eps)
        self.constants = (self.space.functions, options, ops.library_of(settings.energies))

    def correct(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """x [B, V, 3] after a correction, and its length for each matrix [B, matrices]."""
        end, fraction, *_ = _correct(x.contiguous(), *self.touching[1:], *self.rest, *self.constants)
        return end, fraction[:, self.space.of_matrix].to(x.dtype)


_FIELDS = len(ops.TouchingFields._fields)
_INPUTS = _FIELDS + 4  # and mu, lam, rest, packed


def _solved(factor: Tensor, right: Tensor) -> Tensor:
    """(L L')^-1 b [B, F, 3]."""
    with one_thread(factor):
        half = torch.linalg.solve_triangular(factor, right.flatten(1)[..., None], upper=False)
        return torch.linalg.solve_triangular(factor.mT, half, upper=True).reshape(right.shape)


def _run(*args: Any) -> tuple[Tensor, ...]:
    fields, (*shape, packed), (index, options, library) = args[:_FIELDS], args[_FIELDS:_INPUTS], args[_INPUTS:]
    given = (*fields, *index, *shape)
    r, matrix = library.contact_coarse_system(*given, packed, *options)
    with one_thread(matrix):
        factor, info = torch.linalg.cholesky_ex(matrix)
    a = _solved(factor, r)
    x, fraction = library.contact_coarse_move(*given, a, r, info, *options)
    return x, fraction, a, factor


def _reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Tensor | None]:
    fields, (*shape, packed), (fraction, a, factor) = saved[:_FIELDS], saved[_FIELDS:_INPUTS], saved[_INPUTS:]
    index, options, library = rest
    given, f = (*fields, *index, *shape), ops.TouchingFields(*fields)
    l = _solved(factor, library.contact_coarse_restrict(*given, bars[0], fraction, *options))  # noqa: E741
    data, (mu, lam, of_rest, of_packed) = needs[f._fields.index("energy_data")], needs[_FIELDS:]
    wants = [data, mu or lam, of_rest, of_packed]
    *own, material, rest_bar, packed_bar = library.contact_coarse_reverse(*given, packed, a, l, fraction, bars[0],
                                                                         *options, wants)  # fmt: skip
    touching = adjoints_of(own, options[0], data)._asdict()
    by_kappa = touching.pop("by_kappa")
    touching["kappa"] = -sum_of_scenes(by_kappa, listed_of(f), len(f.x))
    return [*(touching.get(name) for name in f._fields), *material.unbind(-1), rest_bar, packed_bar]


# Fields, mu, lam, rest, packed; index, options, library.
_correct = ops.Differentiable(
    _run, _reverse, arguments=_INPUTS + 3, inputs=_INPUTS,
    saved=lambda inputs, made: (*inputs[:_INPUTS], *made[1:]), rest=lambda inputs: inputs[_INPUTS:],
)  # fmt: skip
