"""A soft fingertip that pushes a soft block to a target and feels it."""

from __future__ import annotations

import torch
from torch import Tensor

import diffvbd as dv

from .environment import Environment, State

BLOCK = (0.06, 0.04, 0.06)  # [m]
PAD = (0.015, 0.024, 0.024)  # of the fingertip [m]
DHAT = 0.004  # [m]
PAD_YOUNG = 3e4  # [Pa]
SPEED = 0.078  # largest of the pusher along an axis [m/s]: it must not go all of its gap in a step
REACH = 0.12  # of the pusher along an axis [m]
NEAR, FAR, ASIDE = 0.03, 0.06, 0.015  # least and largest way to the target along x, largest along z [m]
# Costs of 1 m from block to target, of 1 m from the pusher to where it touches the block (without it no gradient would
# say how to come back), and of a mean squared action of 1.
DISTANCE, APART, EFFORT = 20.0, 5.0, 0.02
PRESSURE = 1000.0  # [Pa]; readings are multiples of it


class TactilePush(Environment):
    """A soft fingertip pushes a soft block of 48 vertices over a table to a target. The fingertip feels it.

    The fingertip is a pad of 18 vertices whose back is held by the pusher. Its sensor is the stress in four cells of
    the pad, 2 x 2 across its face: the traction (-pressure, shear along y, shear along z) that :func:`diffvbd.stress`
    gives. Times the area of the face, their mean is the force of contact (:func:`diffvbd.contact.forces`) within a few
    per cent.

    Observations (19): from block to pusher and from block to target along x and z, velocity of the block along x and z,
    its turn about y, tractions of the four cells [kPa].

    Actions (2): velocities of the pusher along x and z, 1 being 0.078 m/s.

    Reward: minus 20 times the distance from block to target [m], 5 times that of the pusher from where it touches the
    back of the block [m], and 0.02 of the mean squared action.
    """

    actions, draws = 2, 3
    young, friction = (3e4, 8e4), (0.3, 0.6)  # young: of the block

    def build(self, dtype: torch.dtype, device: str | torch.device) -> dv.Model:
        block = dv.mesh.box((4, 3, 4), BLOCK, split="kuhn").translate((0.0, 0.0035, -BLOCK[2] / 2))
        # the pad is a little aside: flush meshes are at a kink
        pad = dv.mesh.box((2, 3, 3), PAD, split="kuhn").translate((-0.0038 - PAD[0], 0.0125, 3e-4 - PAD[2] / 2))
        mesh = dv.mesh.join([block, pad])
        energies = (
            dv.StableNeoHookean(),
            dv.FloorBarrier(height=0.0, kappa=400.0, dhat=DHAT),
            dv.PairBarrier(kappa=400.0, dhat=DHAT, self_contact=False, reach=0.016, detections=1, capacity=3000),
            dv.Friction(0.45, velocity=0.02),
        )
        held = mesh.points[:, 0] < -0.0037 - PAD[0]
        model = dv.Model(mesh, 500.0, held, energies, dtype=dtype, device=device)
        like = model.rest_points
        self._block = block.num_vertices
        self._right, self._left = ((like[: self._block, 2] * sign > BLOCK[2] / 2 - 1e-6).nonzero()[:, 0]
                                   for sign in (-1, 1))  # fmt: skip
        center = torch.from_numpy(mesh.points[mesh.tets].mean(1)).to(like)
        self._in_pad = torch.from_numpy(mesh.body[mesh.tets[:, 0]] == 1).to(like.device)
        high, far = center[:, 1] > 0.0125 + PAD[1] / 2, center[:, 2] > 3e-4
        cells = torch.stack([(high == h) & (far == f) & self._in_pad for h in (False, True) for f in (False, True)])
        self._cells = cells.to(like) / cells.sum(1, keepdim=True)  # [4, T]; the tets of a box have one volume
        return model

    def moduli(self, young: Tensor) -> tuple[Tensor, Tensor]:
        pad = torch.full_like(young, PAD_YOUNG)
        return dv.lame(torch.where(self._in_pad, pad[:, None], young[:, None]), self.poisson)

    def start(self, draws: Tensor) -> State:
        shift = self.rest.new_zeros(len(draws), *self.rest.shape)
        shift[:, : self._block, 0] = 1e-3 * draws[:, :1]
        target = torch.stack([NEAR + (FAR - NEAR) * draws[:, 1], ASIDE * (2 * draws[:, 2] - 1)], 1)
        return {"x": self.rest + shift, "pusher": torch.zeros_like(target), "target": target}

    def act(self, state: State, action: Tensor) -> tuple[dict[str, Tensor], State]:
        pusher = (state["pusher"] + SPEED * self.solver.time_step * action).clamp(-REACH, REACH)
        way = torch.stack([pusher[:, 0], torch.zeros_like(pusher[:, 0]), pusher[:, 1]], 1)
        moved = self.model.rest_points + way[:, None]
        return {"prescribed": torch.where(self.model.pinned[:, None], moved, state["x"])}, {"pusher": pusher}

    def _place(self, x: Tensor) -> Tensor:
        """How far the block is from where it lay first, along x and z [B, 2] [m]."""
        return x[:, : self._block].mean(1)[:, ::2] - self.rest[: self._block].mean(0)[::2]

    def tractions(self, state: State) -> Tensor:
        """What the cells of the fingertip feel [B, 4, 3] [Pa], on its face across x: minus the pressure, and shear
        along y and z. Cells are numbered along z, then y."""
        stress = dv.stress(self.model, state["x"], mu=state["mu"], lam=state["lam"]).cauchy
        return torch.einsum("ct,bti->bci", self._cells, stress[..., 0])

    def observe(self, state: State) -> Tensor:
        x, v, block = state["x"], state["v"][:, : self._block], self._place(state["x"])
        across = x[:, self._left].mean(1) - x[:, self._right].mean(1)
        felt = self.tractions(state).flatten(1) / PRESSURE
        ways = [(state["pusher"] - block) / 0.01, (state["target"] - block) / 0.03, v.mean(1)[:, ::2] / SPEED]
        return torch.cat([*ways, across[:, :1] / BLOCK[2], felt], 1)

    def reward(self, before: State, after: State, action: Tensor) -> Tensor:
        block = self._place(after["x"])
        ways = (after["target"] - block, after["pusher"] - block)
        distance, apart = ((way.square().sum(1) + 1e-8).sqrt() for way in ways)  # with a derivative at 0, too
        return -DISTANCE * distance - APART * apart - EFFORT * action.square().mean(1)
