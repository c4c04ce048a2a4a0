"""Shapes of the compiled operators of a coarse space."""

from __future__ import annotations

import torch

from . import coarse_cuda as _cuda  # noqa: F401  (registers what CUDA runs)
from .fields import CoarseFields, CoarseSizes
from .functions import raw_backward, shapes_of

_FIELDS = len(CoarseFields._fields)


@shapes_of("coarse_matrix")
def _(*arguments):
    f = CoarseFields(*arguments[:_FIELDS])
    return f.x_prev.new_empty((f.x_prev.shape[0], 9 * f.mass.shape[-1]))


@shapes_of("coarse_matrix_backward")
def _(*arguments):
    f = CoarseFields(*arguments[:_FIELDS])
    scenes = f.x_prev.shape[0]
    return (torch.empty_like(f.x_prev), f.x_prev.new_empty((scenes, *f.stiffness.shape[1:])),
            f.x_prev.new_empty((scenes, *f.mass.shape[1:])))  # fmt: skip


@shapes_of("coarse_stiffness")
def _(mu, lam, gradients, volume, plan, weights, sizes):
    sizes = CoarseSizes(*sizes)
    return mu.new_empty((_scenes(mu, lam, gradients, volume), sizes.groups, 3, 3, sizes.width, sizes.width))


@shapes_of("coarse_stiffness_backward")
def _(mu, lam, gradients, volume, plan, weights, bar, sizes, wants_rest):
    scenes, tets = _scenes(mu, lam, gradients, volume), gradients.shape[1]
    rest = tets if wants_rest else 0
    return tuple(mu.new_empty((scenes, *own)) for own in ((tets,), (tets,), (rest, 4, 3), (rest,)))


def _scenes(*tensors):
    return max(t.shape[0] for t in tensors)


@shapes_of("coarse_mass")
def _(mass, plan, weights, sizes):
    return mass.new_empty((mass.shape[0], CoarseSizes(*sizes).cells))


@shapes_of("coarse_mass_backward")
def _(bar, plan, weights, sizes):
    return bar.new_empty((bar.shape[0], CoarseSizes(*sizes).vertices))


for _name in ("coarse_matrix", "coarse_stiffness", "coarse_mass"):
    for _end in ("", "_backward"):
        torch.library.register_autograd(f"diffvbd::{_name}{_end}", raw_backward)
