"""Claim: links of a URDF file move as yourdfpy says, differentiably and in batches; contact on them is read as joint
torques; gradients go from joint positions through contact to the body."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import relative_error
from diffvbd.testing.robot_scenes import ARM_URDF, barrier_energy

yourdfpy = pytest.importorskip("yourdfpy")
F64 = torch.float64


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "gripper.urdf"
    file.write_text(ARM_URDF, encoding="utf-8")
    return file


def test_links_move_as_the_file_says(path: Path) -> None:
    robot, expected = dv.robots.load(path), yourdfpy.URDF.load(str(path), load_meshes=False)
    assert robot.joints == ("lift", "turn", "close") and robot.links == ("arm", "hand", "left", "right", "tip")
    assert robot.limits.tolist() == [[-0.2, 0.3], [-1.0, 1.0], [0.0, 0.07]]
    rng = np.random.default_rng(0)
    for q in rng.normal(size=(5, 3)) * 0.3:
        expected.update_cfg(dict(zip(robot.joints, q, strict=True)))
        frames = robot.frames(torch.from_numpy(q))
        for k, name in enumerate(robot.links):
            assert np.allclose(frames[k].numpy(), expected.get_transform(name), atol=1e-12), name
    q = torch.from_numpy(rng.normal(size=(2, 4, 3)))
    batch = robot(q)
    assert batch.shape == (2, 4, robot.rows[-1].stop, 3)
    assert torch.allclose(batch[1, 2], robot(q[1, 2]), atol=1e-14)
    assert torch.autograd.gradcheck(lambda q: robot(q)[..., ::17, :], q[0, :2].clone().requires_grad_())


def test_a_base_moves_all_and_float32_stays(path: Path) -> None:
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.4, 0.1], [0.4, 0.0, 0.3], [-0.1, -0.3, 0.0]], dtype=F64))
    base = torch.eye(4, dtype=F64)
    base[:3, :3], base[:3, 3] = turn, torch.tensor([0.1, 0.2, 0.3])
    q = torch.tensor([0.1, 0.3, 0.02], dtype=F64)
    plain, moved = dv.robots.load(path)(q), dv.robots.load(path, base)(q)
    assert torch.allclose(moved, plain @ turn.mT + base[:3, 3], atol=1e-14)
    assert dv.robots.load(path)(q.float()).dtype == torch.float32


def held(path: Path) -> tuple[dv.robots.Robot, dv.Model, Tensor]:
    """A soft cube between the fingers, which touch it, and joint positions."""
    robot = dv.robots.load(path)
    cube = dv.mesh.box(3, 0.05, split="kuhn").translate((-0.025, 0.19, -0.025))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(self_contact=False), dv.Friction(0.6))
    model = dv.Model(cube, energies=energies, colliders=robot.colliders)
    return robot, model, torch.tensor([0.0, 0.0, 0.0438], dtype=F64)


GIVEN: dict[str, Any] = {"mu": 2e4, "lam": 3e4, "gravity": (0.0, 0.0, 0.0)}


def test_contact_is_read_as_joint_torques(path: Path) -> None:
    """J^T f by the wrenches is minus the derivative of the barriers' potential by each joint."""
    robot, model, q = held(path)
    q = q + torch.tensor([0.0, 0.02, 0.0])
    x = model.rest_points
    about = torch.tensor([0.3, -0.2, 0.1], dtype=F64)
    found = dv.contact.forces(model, x, colliders=robot(q), about=about)
    torques = robot.torques(q, found, about)
    assert found.colliders.total.abs().sum() > 1e-3 and bool((torques.abs() > 1e-9).all())
    with pytest.raises(ValueError, match="first: expected"):
        robot.torques(q, found, about, first=-1)
    with pytest.raises(TypeError, match="forces: expected"):
        robot.torques(q, found.bodies, about)  # type: ignore[arg-type]
    many = dv.contact.forces(model, x.expand(2, -1, -1), colliders=robot(q), about=about)
    assert torch.allclose(robot.torques(q.float(), many, about), torques.expand(2, 3), rtol=1e-4)
    assert torch.allclose(robot.torques(q.expand(4, 1, 3), many, about), torques.expand(4, 2, 3), rtol=1e-9)

    def energy(q: Tensor) -> float:
        return float(barrier_energy(model, x, robot(q)))

    for k, name in enumerate(robot.joints):
        way = 1e-7 * torch.eye(3, dtype=F64)[k]
        slope = torch.tensor((energy(q + way) - energy(q - way)) / 2e-7, dtype=F64)
        assert relative_error(torques[k], -slope) < 1e-6, name


def test_gradients_go_from_joints_to_the_body(path: Path) -> None:
    robot, model, q = held(path)
    x, solver = model.rest_points, dv.VBD(0.01, 8)

    def end(speed: Tensor) -> Tensor:
        def closing(step: int, x: Tensor, v: Tensor) -> Tensor:
            ahead = torch.stack([0.001 * (step + 1) + 0 * speed, 0 * speed, speed * 0.0004 * (step + 1)])
            return robot(q + ahead)

        return dv.rollout(
            model, x, 0 * x, solver, steps=6, colliders=closing, colliders_before=robot(q), save="last", **GIVEN
        ).x[-1]

    speed = torch.tensor(1.0, dtype=F64, requires_grad=True)
    lifted = end(speed)[:, 1].mean() - x[:, 1].mean()
    (slope,) = torch.autograd.grad(lifted, speed)
    with torch.no_grad():
        ends = [float(end(speed + sign * 1e-5)[:, 1].mean()) for sign in (1, -1)]
    assert float(lifted.detach()) > 1e-4 and slope.abs() > 1e-7
    assert relative_error(slope, torch.tensor((ends[0] - ends[1]) / 2e-5, dtype=F64)) < 1e-5


def test_bad_input(path: Path, tmp_path: Path) -> None:
    robot = dv.robots.load(path)
    with pytest.raises(ValueError, match=r"q: expected shape \[\.\.\., 3\] of lift, turn, close, got \[2\]"):
        robot(torch.zeros(2, dtype=F64))
    with pytest.raises(TypeError, match="q: expected a floating-point tensor of joint positions, got"):
        robot([0.0, 0.0, 0.0])
    with pytest.raises(FileNotFoundError, match="missing.urdf"):
        dv.robots.load(tmp_path / "missing.urdf")
    for base in (2 * torch.eye(4), torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0])), torch.eye(3)):
        with pytest.raises(ValueError, match="base: expected a pose"):
            dv.robots.load(path, base)
    other, bare = tmp_path / "other.urdf", ARM_URDF.replace("collision>", "visual>")
    cases = {
        "<mujoco/>": "path: expected",
        bare: "path: expected a robot with collision shapes",
        ARM_URDF.replace("revolute", "floating"): "path: expected joints of the types revolute",
        ARM_URDF.replace('mimic joint="close"', 'mimic joint="clos"'): "mimic: expected",
        ARM_URDF.replace('<child link="tip"/>', '<child link="tipp"/>'): "path: expected joints between links",
        ARM_URDF.replace(
            '<link name="base"/>', '<link name="base"/><link name="lone"/>'
        ): "path: expected one root link",
        ARM_URDF.replace('"0 2 0.2"', '"0 0 0"'): "path: expected joints with an axis, got 'turn'",
        ARM_URDF.replace('name="turn"', 'name="lift"'): "path: expected one joint of each name",
        ARM_URDF.replace("0 0.4 0", "0 nan 0"): "path: expected joints of finite numbers, got 'lift'",
        ARM_URDF.replace('lower="-1"', 'lower="2"'): "path: expected a least position of a joint before the largest",
        ARM_URDF.replace('radius="0.004"', 'radius="0"'): "path: expected collision shapes of finite size > 0",
        ARM_URDF.replace('<child link="tip"/>', '<child link="right"/>'): "path: expected one joint above each link",
        ARM_URDF.replace(
            '<sphere radius="0.004"/>', '<mesh filename="none.stl"/>'
        ): "path: expected a mesh .* 'none.stl'",
    }
    for text, message in cases.items():
        other.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=message):
            dv.robots.load(other)
