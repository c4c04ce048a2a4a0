"""Shapes of the compiled operators of a coarse space."""

from __future__ import annotations

import torch

from .fields import CoarseFields
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


for _name in ("coarse_matrix", "coarse_matrix_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
