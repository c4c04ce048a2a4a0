"""Claim: bodies of an MJCF file move as mujoco says, with references, anchors and equalities of joints; their shapes
are where mujoco has them."""

from pathlib import Path

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd.testing.robot_scenes import ARM_MJCF

mujoco = pytest.importorskip("mujoco")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "arm.xml"
    file.write_text(ARM_MJCF, encoding="utf-8")
    return file


def test_bodies_move_as_mujoco_says(path: Path) -> None:
    robot, m = dv.robots.load(path), mujoco.MjModel.from_xml_path(str(path))
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    assert robot.joints == ("yaw", "slide", "close") and robot.links == ("world", "arm", "hand", "left", "right")
    assert robot.limits.tolist()[0] == [-1.0, 1.0] and bool(torch.isinf(robot.limits[1:]).all())
    for q in rng.normal(size=(5, 3)) * 0.3:
        for name, value in zip(robot.joints, q, strict=True):
            d.joint(name).qpos[:] = value
        d.joint("follow").qpos[:] = 0.01 + 0.002 + 0.5 * q[2]  # where the equality holds
        mujoco.mj_kinematics(m, d)
        frames = robot.frames(torch.from_numpy(q))
        for k, name in enumerate(robot.links):
            assert np.allclose(frames[k, :3, :3].numpy(), d.body(name).xmat.reshape(3, 3), atol=1e-12), name
            assert np.allclose(frames[k, :3, 3].numpy(), d.body(name).xpos, atol=1e-12), name
        points = robot(torch.from_numpy(q)).numpy()
        for name, geom, radius in (("arm", 1, 0.12), ("right", m.geom("pad").id, 0.01 * 14**0.5)):
            own = points[robot.rows[robot.links.index(name)]]  # about the middle of the shape
            assert np.linalg.norm(own - d.geom_xpos[geom], axis=1).max() == pytest.approx(radius, rel=0.01), name


def test_bad_input(tmp_path: Path) -> None:
    file = tmp_path / "other.xml"
    plane = ARM_MJCF.replace('type="box" size="0.3 0.3 0.01"', 'type="plane" size="1 1 1"')
    cases = {
        "<mujoc/>": "path: expected an MJCF file",
        ARM_MJCF.replace('type="slide" axis="1 1 0" ref="0.05"', 'type="ball"'): "hinge and slide",
        ARM_MJCF.replace("0.002 0.5 0 0 0", "0.002 0.5 1 0 0"): "equalities of joints that are linear",
        plane: "a plane or height field of 'world'",
    }
    for text, message in cases.items():
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=message):
            dv.robots.load(file)
