"""Claim: each finger of a gripper has its own friction; fingers hold what Coulomb's law lets them, and the wrenches of
contact on a body that they hold at rest balance its weight."""

import pytest
import torch

import diffvbd as dv
from diffvbd.tasks import lift

pytest.importorskip("yourdfpy")
F64 = torch.float64
RUBBER, STEEL = 0.9, 0.1


def paired(left: float, right: float, others: int = 0) -> torch.Tensor:
    """Coefficients of a block, the left and the right finger, and others without friction."""
    out = torch.zeros(3 + others, 3 + others, dtype=F64)
    out[0, 1:3] = out[1:3, 0] = torch.tensor([left, right], dtype=F64)
    return out


def test_each_link_rubs_by_its_own_coefficient() -> None:
    """A block is held in its middle while the fingers rise along it."""
    robot, block = lift.gripper(0.0), dv.mesh.box(3, 0.02).translate((-0.0097, -0.011, -0.0102))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(500.0, 0.002, self_contact=False),
                dv.Friction(paired(RUBBER, STEEL), 0.005))  # fmt: skip
    middle = abs(block.points[:, 0] - block.points[:, 0].mean()) < 1e-9
    model = dv.Model(block, pinned=middle, energies=energies, colliders=robot.colliders)
    steps = torch.arange(16, dtype=F64)
    q = torch.stack([2e-4 * steps, 0.0385 + 1e-3 * (steps / 10).clamp(max=1)], -1)  # the fingers rise by 2 cm/s
    corners, x, solver = robot(q), model.rest_points, dv.VBD(0.01, 30)
    end = dv.rollout(model, x, 0 * x, solver, steps=15, young=5e5, poisson=0.4, gravity=(0.0, 0.0, 0.0),
                     colliders=dv.per_step(corners[1:]), colliders_before=corners[0])  # fmt: skip
    found = dv.contact.forces(model, end.x[-1], solver, previous=(end.x[-2], end.v[-2]), colliders=corners[-1],
                              colliders_before=corners[-2]).colliders  # fmt: skip
    ratios = found.tangential[0, :, 1] / found.normal[0, :, 0].abs()
    assert found.normal[0, :, 0].abs().min() > 0.1
    torch.testing.assert_close(ratios, torch.tensor([RUBBER, STEEL], dtype=F64), rtol=0.01, atol=0.0)


@pytest.mark.parametrize(("left", "right", "share"), [(RUBBER, RUBBER, 1.0), (STEEL, STEEL, None)])
def test_rubber_holds_what_steel_drops(left: float, right: float, share: float | None) -> None:
    grip = lift.Grip(dv.mesh.box(3, 0.024), paired(left, right, 1))
    steps, solver = lift.smooth_steps((0.15, 0.2, 0.2), 0.01, torch.zeros((), dtype=F64)), dv.VBD(0.01, 40)
    q = grip.positions(7e-4 * steps[:, 0], 0.02 * steps[:, 1])
    end = grip.rollout(q, solver, young=5e4)
    total = grip.forces(q, end, solver)
    carried = total.colliders.total[0].sum(0)
    if share is None:
        assert grip.height(end.x[-1]) < 0.002
        return
    assert grip.height(end.x[-1]) > 0.016
    weight = torch.tensor([0.0, grip.weight, 0.0], dtype=F64)
    assert (carried - weight).norm() < 0.005 * grip.weight
    assert torch.allclose(grip.robot.torques(q[-1], total)[0], -carried[1])
