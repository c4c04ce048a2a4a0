"""Files of robots that tests and benchmarks read, and the energy that forces on their links follow from. The gripper of
the task `lift` is in `diffvbd.tasks.lift`."""

import torch
from torch import Tensor

from .._contact.pair_forces import corner_points, near_pairs, pair_energy
from ..model.model import Model

_LINK = '<link name="{}"><collision><origin xyz="{}" rpy="{}"/><geometry>{}</geometry></collision></link>'
_JOINT = ('<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><origin xyz="{}" rpy="{}"/><axis xyz="{}"/>'
         "{}</joint>")  # fmt: skip
_LIMIT = '<limit lower="{}" upper="{}" effort="10" velocity="1"/>'
# an arm of two joints over a hand of two fingers, of which the second follows the first
ARM_URDF = "\n".join([
    '<?xml version="1.0"?><robot name="gripper">', '<link name="base"/>',
    _LINK.format("arm", "0 0.1 0", "0 0 0", '<cylinder radius="0.02" length="0.15"/>'),
    _LINK.format("hand", "0 0 0", "0.1 0 0", '<box size="0.2 0.03 0.05"/>'),
    _LINK.format("left", "0 -0.06 0", "0 0 0", '<box size="0.02 0.1 0.05"/>'),
    _LINK.format("right", "0 -0.06 0", "0 0 0", '<box size="0.02 0.1 0.05"/>'),
    _LINK.format("tip", "0 0 0.01", "0 0 0", '<sphere radius="0.004"/>'),
    _JOINT.format("lift", "prismatic", "base", "arm", "0 0.4 0", "0 0 0", "0 1 0", _LIMIT.format(-0.2, 0.3)),
    _JOINT.format("turn", "revolute", "arm", "hand", "0 -0.1 0", "0 0 0", "0 2 0.2", _LIMIT.format(-1, 1)),
    _JOINT.format("close", "prismatic", "hand", "left", "-0.08 0 0", "0 0 0", "1 0 0", _LIMIT.format(0, 0.07)),
    _JOINT.format("follow", "prismatic", "hand", "right", "0.08 0 0", "0 0 0", "-1 0 0",
                 _LIMIT.format(0, 0.07) + '<mimic joint="close" multiplier="1.0" offset="0.0005"/>'),
    _JOINT.format("weld", "fixed", "left", "tip", "0 -0.13 0", "0.3 0.1 -0.2", "1 0 0", ""),
    "</robot>",
])  # fmt: skip
# an arm of two joints, references of joints, and an equality of two
ARM_MJCF = """<mujoco><compiler angle="radian"/><asset><mesh name="wedge"
vertex="0 0 0 0.05 0 0 0 0.04 0 0 0 0.03"/></asset>
<worldbody><geom name="table" type="box" size="0.3 0.3 0.01" pos="0 0 -0.2"/>
<body name="arm" pos="0.1 0 0.3" quat="0.9 0.1 0.2 0.3">
<joint name="yaw" axis="0 0 2" range="-1 1" ref="0.2" pos="0.01 0.02 0"/>
<joint name="slide" type="slide" axis="1 1 0" ref="0.05"/>
<geom type="capsule" size="0.02 0.1" pos="0 0 0.1" euler="0.3 0 0"/>
<geom type="sphere" size="0.1" contype="0" conaffinity="0"/>
<body name="hand" pos="0 0 0.25"><geom type="cylinder" size="0.03 0.02"/>
<geom type="ellipsoid" size="0.02 0.03 0.04" pos="0 0.1 0"/>
<body name="left" pos="0.05 0 0"><joint name="close" type="slide" axis="-1 0 0"/><geom type="mesh" mesh="wedge"/></body>
<body name="right" pos="-0.05 0 0"><joint name="follow" type="slide" axis="1 0 0" ref="0.01"/>
<geom name="pad" type="box" size="0.01 0.02 0.03"/></body></body></body></worldbody>
<equality><joint joint1="follow" joint2="close" polycoef="0.002 0.5 0 0 0"/></equality></mujoco>"""


def barrier_energy(model: Model, x: Tensor, corners: Tensor) -> Tensor:
    """Potential of the pairs of a PairBarrier [J] at positions x [V, 3] and corner points of the colliders [Vc, 3]."""
    assert model.contact is not None and model.surface_of_contact is not None
    given = x[None], None, corners[None]
    near = near_pairs(*given, corners[None], model.surface_of_contact, model.contact)
    kappa = torch.tensor([model.contact.kappa], dtype=torch.float64)
    return pair_energy(near, near.positions(corner_points(*given)), kappa).sum()
