"""Anderson acceleration of the iterates of a step, in plain torch, differentiated by autograd.

    next = g_k - dG gamma        gamma = (dF^T M dF + eps diag)^-1 dF^T M f_k        f_i = g_i - x_i

for each connected body on its own; g_k itself where the combination would raise the body's incremental potential.
"""

from typing import Any

import torch
from torch import Tensor

from .rigid import admits, connected_bodies
from .scene import Scene, dot, put, take

REGULARIZATION = 1e-6  # of the diagonal
ROUNDING = 8  # ulps of the potential's terms by which it may rise all the same


class Anderson:
    """The acceleration of a run; ``energies``: the reference formulas, all of them."""

    def __init__(self, scene: Scene, energies: list[Any]) -> None:
        free = ~scene.model.pinned
        self.scene, self.energies, self.window = scene, energies, scene.model.acceleration.window
        # with pinned vertices first, whose tets count; then what moves alone
        whole = [b for b in connected_bodies(scene.model) if bool(free[b].any())]
        self.bodies = [b[free[b]] for b in whole]
        self.body = torch.full((len(free),), len(whole), device=free.device)
        for i, body in enumerate(whole):
            self.body[body] = i

    def cycles(self, sweeps: int, every: int | None) -> list[int]:
        """Sweeps of each cycle, with corrections the first sweep alone; [sweeps] where nothing is combined."""
        alone = [] if every is None else [1]
        left = sweeps - len(alone)
        every = every or 1
        cycles = [min(every, left - begun) for begun in range(0, left, every)]
        return [*alone, *cycles] if len(cycles) > 2 else [sweeps]

    def combine(
        self,
        before: list[Tensor],
        after: list[Tensor],
        y: Tensor,
        x_prev: Tensor,
        taken: Tensor | None,
        sets: Tensor | None = None,
    ) -> Tensor:
        """The next iterate from the last ones and what a cycle made of each [..., 3, V]; taken [..., bodies]: which
        bodies take the combination, which is decided if it is not given; sets [..., bodies]: equal for bodies that have
        one combination, each its own if not given."""
        before, after = before[-self.window - 1 :], after[-self.window - 1 :]
        residuals = [g - x for x, g in zip(before, after, strict=True)]
        systems, ways = [], []
        for body in self.bodies:
            f = [take(r, body) for r in residuals]
            g = [take(a, body) for a in after]
            of_f, of_g = (torch.stack([q - p for p, q in zip(v[:-1], v[1:], strict=True)], -1) for v in (f, g))
            weighted = self.scene.mass[..., None, body, None] * of_f
            right = torch.einsum("...cvi,...cv->...i", weighted, f[-1])
            systems.append(torch.cat((torch.einsum("...cvi,...cvj->...ij", weighted, of_f), right[..., None]), -1))
            ways.append(of_g)
        system = torch.stack(systems, -3)
        if sets is not None:
            together = (sets[..., :, None] == sets[..., None, :]).to(system)
            system = torch.einsum("...bc,...cij->...bij", together, system)
        normal, right = system[..., :-1], system[..., -1:]
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        gamma = torch.linalg.solve(
            normal + torch.diag_embed(torch.where(diagonal > 0, REGULARIZATION * diagonal, 1.0)), right
        )
        state = after[-1]
        for b, body in enumerate(self.bodies):
            way = (ways[b] @ gamma[..., b, :, :].unsqueeze(-3))[..., 0]
            moved = put(state, body, take(after[-1], body) - way)
            good = self._falls(b, state, moved, y, x_prev) if taken is None else taken[..., b]
            state = torch.where(good[..., None, None], moved, state)
        return state

    @torch.no_grad()
    def _falls(self, b: int, state: Tensor, moved: Tensor, y: Tensor, x_prev: Tensor) -> Tensor:
        rise, size = self.rise(state, moved, y, x_prev)
        kept = admits(self.energies, moved, state, self.bodies[b])
        return (rise[..., b] <= ROUNDING * torch.finfo(state.dtype).eps * size[..., b]) & kept

    def rise(self, x: Tensor, to: Tensor, y: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        """By how much the potential of each body rises from x to `to` [..., 3, V], and the sum of its terms' sizes,
        [..., bodies] each."""

        def terms(z: Tensor) -> list[tuple[Tensor, Tensor]]:
            inertia = self.scene.mass / 2 * dot(z - y, z - y)
            parts = [energy.terms(z, x_prev) for energy in self.energies]
            return [(inertia, self.body), *((term, self.body[vertex]) for term, vertex in parts)]

        lead = x.shape[:-2]
        total = size = x.new_zeros((*lead, len(self.bodies) + 1))
        for (before, body), (after, _) in zip(terms(x), terms(to), strict=True):
            total = total.index_add(-1, body, (after - before).expand(*lead, -1))
            size = size.index_add(-1, body, before.abs().expand(*lead, -1))
        return total[..., :-1], size[..., :-1]
