"""A law at a state, in torch: the energy of tets, its derivatives and the stress, from the scalars of the rest shape
that the kernels read: k01 k02 k03 k12 k13 k23, c6, with fibres a0 . grad N of the corners; with viscosity the weights,
c6 and the moduli of a second law; then the parameters.
"""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from .density import Density

PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # corners of the first six scalars
FIBRE = 7  # the first scalar of a fibre
VISCOUS = 9  # scalars of viscosity; twin of TetLayout in csrc/energies/own_layout.h


def measures(density: Density, corners: Tensor, rest: Tensor) -> tuple[Tensor, list[Tensor], Tensor | None]:
    """B = F F^T [..., T, 3, 3], (I1, I2, J, I4) and F a0 [..., T, 3]; corners [..., T, 4, 3], rest [..., T, n].

    B = -6 c6 sum k_ab e_ab e_ab^T (docs/method.md, section 24).
    """
    one, two = torch.tensor(PAIRS, device=corners.device).T
    edges = corners[..., two, :] - corners[..., one, :]  # [..., T, 6, 3]
    c6 = rest[..., 6]
    weighted = edges * rest[..., :6, None]
    b = -6 * c6[..., None, None] * (weighted[..., :, None] * edges[..., None, :]).sum(-3)
    trace = b[..., 0, 0] + b[..., 1, 1] + b[..., 2, 2]
    second = (trace * trace - (b * b).sum((-2, -1))) / 2
    ratio = c6 * (edges[..., 0, :] * torch.linalg.cross(edges[..., 1, :], edges[..., 2, :])).sum(-1)
    fibre, fourth = None, torch.ones_like(ratio)
    if density.fibre:
        moved = corners[..., 1:, :] - corners[..., :1, :]
        fibre = (rest[..., FIBRE + 1 : FIBRE + 4, None] * moved).sum(-2)
        fourth = (fibre * fibre).sum(-1)
    return b, [trace, second, ratio, fourth], fibre


def first_viscous(density: Density) -> int:
    """Where the scalars of viscosity stand, or else the parameters."""
    return FIBRE + 4 if density.fibre else FIBRE


def parameters_of(density: Density, rest: Tensor) -> list[Tensor]:
    return list(rest[..., rest.shape[-1] - len(density.parameters) :].unbind(-1))


def energy(density: Density, corners: Tensor, rest: Tensor) -> Tensor:
    """V psi of each tet [J], [..., T], and what viscosity adds to it in a step."""
    _, invariants, _ = measures(density, corners, rest)
    own = density.value(invariants, parameters_of(density, rest))[0] / (6 * rest[..., 6])
    first = first_viscous(density)
    if rest.shape[-1] == first + len(density.parameters):
        return own
    *weights, c6, mu, lam = rest[..., first : first + VISCOUS].unbind(-1)
    one, two = torch.tensor(PAIRS, device=corners.device).T
    squares = (corners[..., two, :] - corners[..., one, :]).square().sum(-1)
    strain = c6 * invariants[2] / rest[..., 6] - 1  # J is c6 six volumes
    of_volume = ((mu + lam) / 2 * strain.square() - mu * strain) / (6 * c6)
    return own - mu / 2 * (torch.stack(weights, -1) * squares).sum(-1) + of_volume


def cauchy(density: Density, corners: Tensor, rest: Tensor) -> Tensor:
    """Cauchy stress [Pa], [..., T, 3, 3]: 2/J [(w_1 + I1 w_2) B - w_2 B^2 + w_4 Fa Fa^T] + w_J I."""
    b, invariants, fibre = measures(density, corners, rest)
    w1, w2, wj, w4 = (w[..., None, None] for w in density.slopes(invariants, parameters_of(density, rest)))
    i1, ratio = invariants[0][..., None, None], invariants[2][..., None, None]
    square = (b[..., :, :, None] * b[..., None, :, :]).sum(-2)
    out = (w1 + i1 * w2) * b - w2 * square
    if fibre is not None:
        out = out + w4 * fibre[..., :, None] * fibre[..., None, :]
    return 2 / ratio * out + wj * torch.eye(3, dtype=b.dtype, device=b.device)


class LawTets:
    """The energy of tets at a state, its gradient and its Hessian, times h^2; detached."""

    def __init__(self, density: Density, corners: Tensor, rest: Tensor, h: float) -> None:
        """corners [B, T, 4, 3]; rest [1 | B, T, n]."""
        self.density, self.h2 = density, h * h
        with torch.inference_mode(False):  # clones: what was made in inference mode cannot be differentiated
            self.corners, self.rest = (t.detach().clone().requires_grad_() for t in (corners, rest))

    @cached_property
    def size(self) -> Tensor:
        """The sizes of the terms of each scene's energy, [B], whose rounding the energy has: it may be small where they
        are not. Those of viscosity are left out: only statics ask, which have none."""
        corners, rest = self.corners.detach(), self.rest.detach()
        _, invariants, _ = measures(self.density, corners, rest)
        slopes = self.density.slopes(invariants, parameters_of(self.density, rest))
        terms = sum((w * i).abs() for w, i in zip(slopes, invariants, strict=True))
        return self.h2 * (terms / (6 * rest[..., 6])).sum(-1)

    @cached_property
    def _gradient(self) -> Tensor:
        with torch.inference_mode(False), torch.enable_grad():
            total = self.h2 * energy(self.density, self.corners, self.rest)
            return torch.autograd.grad(total.sum(), self.corners, create_graph=True)[0]

    def gradient(self) -> Tensor:
        """[B, T, 4, 3]."""
        return self._gradient.detach()

    def product(self, w: Tensor) -> Tensor:
        """Hessian times w, [B, T, 4, 3] both."""
        return torch.autograd.grad(self._gradient, self.corners, w, retain_graph=True)[0]

    def of_rest(self, w: Tensor) -> Tensor:
        """Derivative of -w . gradient by the scalars of the rest shape of each scene, [B, T, n]."""
        with torch.inference_mode(False), torch.enable_grad():
            rest = self.rest.detach().expand(len(w), *self.rest.shape[1:]).clone().requires_grad_()
            total = self.h2 * energy(self.density, self.corners, rest)
            gradient = torch.autograd.grad(total.sum(), self.corners, create_graph=True)[0]
            return torch.autograd.grad(-(w.detach().clone() * gradient).sum(), rest)[0]

    @cached_property
    def hessian(self) -> Tensor:
        """[B, T, 4, 4, 3, 3]: corners, then components."""
        with torch.inference_mode(False), torch.enable_grad():
            rows = [torch.autograd.grad(self._gradient[..., a, c].sum(), self.corners, retain_graph=True)[0]
                    for a in range(4) for c in range(3)]  # fmt: skip
        return torch.stack(rows, 2).unflatten(2, (4, 3)).transpose(3, 4)
