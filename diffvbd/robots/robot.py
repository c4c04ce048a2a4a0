"""Links of a robot whose poses follow from joint positions, in torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._common.checks import check_count, check_kind, fail, kind_of
from .._contact.colliders import Obstacle
from ..inspect.forces import Forces


class Joint(NamedTuple):
    """A joint between two links, as files describe it."""

    name: str
    kind: Literal["turns", "slides", "fixed"]
    parent: str
    child: str
    origin: NDArray[np.float64]  # of the joint in its parent [4, 4]
    axis: NDArray[np.float64]  # in the joint's own frame [3]
    limits: tuple[float, float]
    leader: str  # the joint whose position moves it, or itself: by factor times that, and offset
    factor: float = 1.0
    offset: float = 0.0


class _Tensors(NamedTuple):
    """Constants of a Robot on a device."""

    base: Tensor  # [4, 4]
    origins: tuple[Tensor, ...]  # of each joint [4, 4]
    axes: tuple[Tensor, ...]  # [3]
    points: tuple[Tensor, ...]  # of each link [n, 3]


class Description(NamedTuple):
    """A robot as a file describes it."""

    links: list[str]
    joints: list[Joint]
    surfaces: dict[str, tuple[NDArray[np.float64], NDArray[np.int64]]]  # points and triangles in the frame of a link


class Robot:
    """Links of a robot and how joints move them; see :func:`load`, which makes one.

    Attributes:
        joints: Names of the joints that a position moves, n of them in the order of the file. Joints that mimic others
            are not among them.
        limits: Least and largest position of each [n, 2], float64 [rad, or m of a prismatic joint]; infinite where
            there is none. A range that a URDF file leaves out is [0, 0], as its format says.
        links: Names of the links with a collision shape, in the order of their colliders.
        colliders: An Obstacle for each of them, at the positions 0, for ``Model(colliders=...)``.
        rows: Slice of each collider's corner points among those of all, Vc of them.
    """

    def __init__(self, given: Description, base: Tensor) -> None:
        self.base, self._joints = base, joints = base, _in_order(given)
        moving = [joint for joint in joints if joint.kind != "fixed"]
        own = [joint for joint in given.joints if joint.kind != "fixed" and joint.leader == joint.name]
        self.joints = tuple(joint.name for joint in own)
        self.limits = torch.tensor([joint.limits for joint in own], dtype=torch.float64).reshape(-1, 2)
        self._roots = set(given.links) - {joint.child for joint in joints}
        for joint in moving:
            if joint.leader not in self.joints:
                fail("mimic", f"a joint for {joint.name!r} to follow that follows none itself", repr(joint.leader))
        self._number = {joint.name: self.joints.index(joint.leader) for joint in moving}
        self._origins = torch.from_numpy(np.array([joint.origin for joint in joints], dtype=np.float64))
        axes = np.array([joint.axis for joint in joints], dtype=np.float64).reshape(-1, 3)
        lengths = np.linalg.norm(axes, axis=1, keepdims=True)
        for joint, length in zip(joints, lengths[:, 0].tolist(), strict=True):
            if not np.isfinite([*np.ravel(joint.origin), *joint.axis, joint.factor, joint.offset]).all():
                fail("path", "joints of finite numbers", f"{joint.name!r}, which has others")
            if not joint.limits[0] <= joint.limits[1]:
                fail("path", "a least position of a joint before the largest", f"{joint.limits} of {joint.name!r}")
            if joint.kind != "fixed" and not length > 0:
                fail("path", "joints with an axis", f"{joint.name!r}, whose axis is 0")
        self._axes = torch.from_numpy(axes / np.where(lengths > 0, lengths, 1.0))
        surfaces = given.surfaces
        self.links = tuple(surfaces)
        if not self.links:
            fail("path", "a robot with collision shapes", "none")
        for name, (points, triangles) in surfaces.items():
            if not len(triangles) or not np.isfinite(points).all():
                fail("path", "collision shapes of finite size > 0", f"one of link {name!r}")
        self._points = [torch.from_numpy(surfaces[name][0]) for name in self.links]  # of each link, in its frame
        ends = np.cumsum([0, *map(len, self._points)]).tolist()
        self.rows = tuple(map(slice, ends[:-1], ends[1:]))
        self._kept: dict[tuple[torch.device, torch.dtype], _Tensors] = {}
        at_rest = self(torch.zeros(len(self.joints), dtype=torch.float64)).numpy()
        self.colliders = tuple(Obstacle(at_rest[rows], surfaces[name][1])
                               for name, rows in zip(self.links, self.rows, strict=True))  # fmt: skip

    def __repr__(self) -> str:
        return f"Robot(joints={list(self.joints)}, links={list(self.links)})"

    def __call__(self, q: Tensor) -> Tensor:
        """Corner points of all colliders [..., Vc, 3] [m] at joint positions q [..., n], differentiable. A step takes
        them as ``colliders``, a rollout a function of (step, x, v) that returns them."""
        frames = self.frames(q)
        parts = [points @ frames[..., k, :3, :3].mT + frames[..., k, None, :3, 3]
                 for k, points in enumerate(self._tensors(q).points)]  # fmt: skip
        return torch.cat(parts, -2)

    def _tensors(self, like: Tensor) -> _Tensors:
        """Constants on a device, kept from the first use: the capture of a CUDA graph admits no copies to it."""
        key = like.device, like.dtype
        if key not in self._kept:
            with torch.inference_mode(False):
                moved = [tuple(t.to(*key) for t in part) for part in (self._origins, self._axes, self._points)]
                self._kept[key] = _Tensors(self.base.to(*key), *moved)
        return self._kept[key]

    def frames(self, q: Tensor) -> Tensor:
        """Poses of the links in the world [..., links, 4, 4] at joint positions q [..., n] [rad, m], differentiable.

        Raises:
            TypeError, ValueError: For what is no tensor of n joint positions.
        """
        poses, _ = self._poses(q)
        return torch.stack([poses[name] for name in self.links], -3)

    def torques(self, q: Tensor, forces: Forces, about: Tensor | Sequence[float] = (0.0, 0.0, 0.0), first: int = 0
                ) -> Tensor:  # fmt: skip
        """What contact with bodies puts on each joint [..., n]: torques [N m], of prismatic joints forces [N]; J^T f of
        the wrenches on the links. Differentiable. A drive that holds the joints bears the opposite.

        Args:
            q: Joint positions [..., n].
            forces: Of :func:`diffvbd.contact.forces` with the robot's colliders at q.
            about: The point that these torques are about [m], shape [3] or [..., 3].
            first: The number of the robot's first collider among those of the Model.
        """
        check_kind("forces", forces, Forces)
        own = slice(check_count("first", first), first + len(self.links))
        total, torque = (-part.sum(-3)[..., own, :] for part in (forces.colliders.total, forces.colliders.torque))
        if total.shape[-2] != len(self.links):
            fail("forces", f"those of {len(self.links)} colliders from number {first} on", f"{total.shape[-2]}")
        about = torch.as_tensor(about, dtype=total.dtype, device=total.device)
        if about.shape != (3,) and about.shape != (*total.shape[:-2], 3):
            fail("about", f"shape [3] or {[*total.shape[:-2], 3]}", list(about.shape))
        _, pivots = self._poses(q.to(total.dtype) if isinstance(q, Tensor) else q)
        lead = torch.broadcast_shapes(q.shape[:-1], total.shape[:-2], about.shape[:-1])
        out = [total.new_zeros(lead)] * len(self.joints)
        for k, name in enumerate(self.links):
            for joint in self._above(name):
                of, (pivot, axis) = self._joints[joint], pivots[joint]
                if of.kind == "fixed":
                    continue
                if of.kind == "turns":
                    arm = torch.linalg.cross(*torch.broadcast_tensors(about - pivot, total[..., k, :]))
                    work = (axis * (torque[..., k, :] + arm)).sum(-1)
                else:
                    work = (axis * total[..., k, :]).sum(-1)
                number = self._number[of.name]
                out[number] = out[number] + of.factor * work
        return torch.stack(out, -1) if out else total.new_zeros((*lead, 0))

    def _above(self, link: str) -> list[int]:
        """Joints between the base and a link."""
        by_child = {joint.child: k for k, joint in enumerate(self._joints)}
        out = []
        while link in by_child:
            out.append(by_child[link])
            link = self._joints[out[-1]].parent
        return out

    def _poses(self, q: Tensor) -> tuple[dict[str, Tensor], list[tuple[Tensor, Tensor]]]:
        """Poses of all links by name [..., 4, 4]; a point and the axis of each joint in the world [..., 3]."""
        if not isinstance(q, Tensor) or not q.is_floating_point():
            raise TypeError(f"q: expected a floating-point tensor of joint positions, got {kind_of(q)}")
        if q.dim() == 0 or q.shape[-1] != len(self.joints):
            fail("q", f"shape [..., {len(self.joints)}] of {', '.join(self.joints) or 'no joint'}", list(q.shape))
        own = self._tensors(q)
        poses, pivots = dict.fromkeys(self._roots, own.base.expand(*q.shape[:-1], 4, 4)), []
        for k, joint in enumerate(self._joints):
            at, axis = poses[joint.parent] @ own.origins[k], own.axes[k]
            pivots.append((at[..., :3, 3], (at[..., :3, :3] * axis).sum(-1)))
            if joint.kind != "fixed":
                value = joint.factor * q[..., self._number[joint.name]] + joint.offset
                at = at @ (_turned(axis, value) if joint.kind == "turns" else _shifted(axis, value))
            poses[joint.child] = at
        return poses, pivots


def _in_order(given: Description) -> list[Joint]:
    """Joints, parents before their children."""
    for rule, names in (("one joint of each name", [joint.name for joint in given.joints]),
                        ("one link of each name", given.links),
                        ("one joint above each link", [joint.child for joint in given.joints])):  # fmt: skip
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            fail("path", rule, twice[0])
    unknown = [joint.child for joint in given.joints if joint.child not in given.links]
    if unknown:
        fail("path", "joints between links of the file", repr(unknown[0]))
    known = set(given.links) - {joint.child for joint in given.joints}
    if len(known) > 1:
        fail("path", "one root link", ", ".join(sorted(known)))
    out, left = [], list(given.joints)
    while left:
        ready = [joint for joint in left if joint.parent in known]
        if not ready:
            fail("path", "joints that make a tree", f"a loop or an unknown link at {left[0].name!r}")
        out += ready
        known |= {joint.child for joint in ready}
        left = [joint for joint in left if joint.parent not in known or joint.child not in known]
    return out


def _turned(axis: Tensor, angle: Tensor) -> Tensor:
    """Rotations about a unit axis [3] by angles [...], as poses [..., 4, 4] (Rodrigues' formula)."""
    x, y, z = axis.unbind()
    zero = torch.zeros_like(x)
    k = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    angle = angle[..., None, None]
    turn = torch.eye(3, dtype=axis.dtype, device=axis.device) + angle.sin() * k + (1 - angle.cos()) * (k @ k)
    return _pose(turn, torch.zeros_like(turn[..., 0]))


def _shifted(axis: Tensor, length: Tensor) -> Tensor:
    shift = length[..., None] * axis
    return _pose(torch.eye(3, dtype=axis.dtype, device=axis.device).expand(*shift.shape, 3), shift)


def _pose(turn: Tensor, shift: Tensor) -> Tensor:
    last = torch.zeros_like(turn[..., :1, :])
    column = torch.cat([shift[..., None], torch.ones_like(shift[..., :1, None])], -2)
    return torch.cat([torch.cat([turn, last], -2), column], -1)
