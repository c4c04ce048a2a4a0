"""Robots as colliders: links of a URDF file whose poses follow from joint positions, in torch (docs/guides/robots.md).

A Robot is kinematic: joint positions move its links, each of which is an Obstacle of a Model, and forces of contact are
read as joint torques. yourdfpy reads the file, trimesh its meshes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from os import PathLike, fspath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ._common.checks import check_tensor, fail
from ._contact.colliders import Obstacle
from .inspect.forces import Forces

MOVES = {"revolute": True, "continuous": True, "prismatic": False}  # whether a joint of the type turns
ROUND = 16  # corners of the circle of a cylinder
INSTALL = "robots: expected yourdfpy, which is not installed: pip install 'diffvbd[robots]'"


class Robot:
    """Links of a robot and how joints move them; see :func:`load`, which makes one.

    Attributes:
        joints: Names of the joints that a position moves, n of them. Joints that mimic others are not among them.
        limits: Least and largest position of each [n, 2], float64 [rad, or m of a prismatic joint]; infinite where
            there is none.
        links: Names of the links with a collision shape, in the order of their colliders.
        colliders: An Obstacle for each of them, at the positions 0, for ``Model(colliders=...)``.
        rows: Slice of each collider's corner points among those of all, Vc of them.
    """

    def __init__(self, urdf: Any, base: Tensor) -> None:
        joints = _in_order(urdf.robot)
        self.base = base
        self.joints = tuple(j.name for j in joints if j.type in MOVES and j.mimic is None)
        self.limits = torch.tensor([_limits(j) for j in joints if j.name in self.joints], dtype=torch.float64)
        self.limits = self.limits.reshape(-1, 2)
        self._roots = {link.name for link in urdf.robot.links} - {joint.child for joint in joints}
        self._joints = joints
        number = {name: k for k, name in enumerate(self.joints)}
        self._moved_by: list[tuple[int, float, float] | None] = []  # joint position, factor and offset
        for joint in joints:
            factor, offset, leader = 1.0, 0.0, joint.name
            if joint.mimic is not None:
                given = joint.mimic.multiplier, joint.mimic.offset
                factor, offset = (own if value is None else value for own, value in zip((1.0, 0.0), given, strict=True))
                leader = joint.mimic.joint
            if joint.type in MOVES and leader not in number:
                fail("mimic", f"a joint that {joint.name!r} follows and that moves", repr(leader))
            self._moved_by.append((number[leader], factor, offset) if joint.type in MOVES else None)
        origins = [np.eye(4) if j.origin is None else j.origin for j in joints]
        axes = [np.array([1.0, 0.0, 0.0]) if j.axis is None else j.axis for j in joints]
        self._origins = torch.from_numpy(np.array(origins).reshape(-1, 4, 4).astype(np.float64))
        lengths = np.linalg.norm(np.array(axes).reshape(-1, 3), axis=1, keepdims=True)
        self._axes = torch.from_numpy(np.array(axes).reshape(-1, 3) / np.where(lengths > 0, lengths, 1.0))
        surfaces = {link.name: _surface(urdf, link) for link in urdf.robot.links if link.collisions}
        self.links = tuple(surfaces)
        if not self.links:
            fail("path", "a robot with collision shapes", "none")
        self._points = [torch.from_numpy(surfaces[name][0]) for name in self.links]  # of each link, in its frame
        ends = np.cumsum([0, *map(len, self._points)]).tolist()
        self.rows = tuple(map(slice, ends[:-1], ends[1:]))
        at_rest = self(torch.zeros(len(self.joints), dtype=torch.float64)).numpy()
        self.colliders = tuple(Obstacle(at_rest[rows], surfaces[name][1])
                               for name, rows in zip(self.links, self.rows, strict=True))  # fmt: skip

    def __repr__(self) -> str:
        return f"Robot(joints={list(self.joints)}, links={list(self.links)})"

    def __call__(self, q: Tensor) -> Tensor:
        """Corner points of all colliders [..., Vc, 3] [m] at joint positions q [..., n], differentiable: what
        :func:`diffvbd.step` takes as ``colliders``, and a function of these what :func:`diffvbd.rollout` takes."""
        frames = self.frames(q)
        parts = [points.to(q) @ frames[..., k, :3, :3].mT + frames[..., k, None, :3, 3]
                 for k, points in enumerate(self._points)]  # fmt: skip
        return torch.cat(parts, -2)

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
        own = slice(first, first + len(self.links))
        total, torque = (-part.sum(-3)[..., own, :] for part in (forces.colliders.total, forces.colliders.torque))
        if total.shape[-2] != len(self.links):
            fail("forces", f"those of {len(self.links)} colliders from number {first} on", f"{total.shape[-2]}")
        about = torch.as_tensor(about, dtype=total.dtype, device=total.device)
        poses, pivots = self._poses(q)
        out: list[Any] = [torch.zeros_like(total[..., 0, 0])] * len(self.joints)
        for k, name in enumerate(self.links):
            for joint in self._above(name):
                moved = self._moved_by[joint]
                if moved is None:
                    continue
                pivot, axis = pivots[joint]
                if MOVES[self._joints[joint].type]:
                    arm = torch.linalg.cross(about - pivot, total[..., k, :])
                    work = (axis * (torque[..., k, :] + arm)).sum(-1)
                else:
                    work = (axis * total[..., k, :]).sum(-1)
                out[moved[0]] = out[moved[0]] + moved[1] * work
        return torch.stack(out, -1)

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
            raise TypeError(f"q: expected a tensor of joint positions, got {type(q).__name__}")
        if q.dim() == 0 or q.shape[-1] != len(self.joints):
            fail("q", f"shape [..., {len(self.joints)}] of {', '.join(self.joints) or 'no joint'}", list(q.shape))
        base = self.base.to(q).expand(*q.shape[:-1], 4, 4)
        poses, pivots = dict.fromkeys(self._roots, base), []
        for k, joint in enumerate(self._joints):
            at = poses[joint.parent] @ self._origins[k].to(q)
            axis = self._axes[k].to(q)
            pivots.append((at[..., :3, 3], (at[..., :3, :3] * axis).sum(-1)))
            moved = self._moved_by[k]
            if moved is not None:
                value = moved[1] * q[..., moved[0]] + moved[2]
                at = at @ (_turned(axis, value) if MOVES[joint.type] else _shifted(axis, value))
            poses[joint.child] = at
        return poses, pivots


def load(path: str | PathLike[str], base: Tensor | None = None) -> Robot:
    """A robot of a URDF file, with the collision shapes of its links.

    Boxes, cylinders, spheres and meshes become triangles; the shapes of a link one Obstacle.

    Args:
        path: The file. Meshes are looked for beside it, as yourdfpy does.
        base: Pose of the root link in the world [4, 4]; None: the identity.

    Raises:
        FileNotFoundError: Without such a file.
        ImportError: Without yourdfpy.
        ValueError: For a file that is no URDF or has no collision shape, a joint of another type than revolute,
            continuous, prismatic and fixed, and a base that is no pose.
    """
    try:
        from yourdfpy import URDF
    except ImportError:
        raise ImportError(INSTALL) from None
    with open(path, "rb"):  # the error of a missing file names it
        pass
    try:
        urdf = URDF.load(fspath(path), build_scene_graph=False, load_meshes=False)
    except Exception as error:  # of its parser
        raise ValueError(f"path: expected a URDF file, got {fspath(path)!r} ({error})") from error
    like = torch.eye(4, dtype=torch.float64)
    base = like if base is None else check_tensor("base", base.to(torch.float64), like)
    turn = base[:3, :3] if base.shape == (4, 4) else None
    if turn is None or not torch.allclose(turn @ turn.mT, like[:3, :3], atol=1e-6) or not torch.equal(base[3], like[3]):
        fail("base", "a pose [4, 4]: a rotation, a translation, and 0, 0, 0, 1", base.tolist())
    return Robot(urdf, base)


def _limits(joint: Any) -> list[float]:
    if joint.limit is None or joint.type == "continuous":
        return [-math.inf, math.inf]
    return [0.0 if value is None else value for value in (joint.limit.lower, joint.limit.upper)]


def _in_order(robot: Any) -> list[Any]:
    """Joints, parents before their children."""
    for joint in robot.joints:
        if joint.type not in (*MOVES, "fixed"):
            fail("path", f"joints of the types {', '.join(MOVES)} and fixed", f"{joint.name!r}, which is {joint.type}")
    children = {joint.child for joint in robot.joints}
    known = {link.name for link in robot.links} - children
    out, left = [], list(robot.joints)
    while left:
        ready = [joint for joint in left if joint.parent in known]
        if not ready:
            fail("path", "joints that make a tree", f"a loop or an unknown link at {left[0].name!r}")
        out += ready
        known |= {joint.child for joint in ready}
        left = [joint for joint in left if joint not in ready]
    return out


def _surface(urdf: Any, link: Any) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points and triangles of a link's collision shapes in its frame."""
    import trimesh

    points, triangles, count = [], [], 0
    mesh: Any
    for collision in link.collisions:
        shape = collision.geometry
        if shape.box is not None:
            mesh = trimesh.creation.box(shape.box.size)
        elif shape.cylinder is not None:
            mesh = trimesh.creation.cylinder(shape.cylinder.radius, shape.cylinder.length, sections=ROUND)
        elif shape.sphere is not None:
            mesh = trimesh.creation.icosphere(2, shape.sphere.radius)
        else:
            mesh = trimesh.load(urdf._filename_handler(shape.mesh.filename), force="mesh")
            if shape.mesh.scale is not None:
                mesh.apply_scale(shape.mesh.scale)
        mesh.merge_vertices()
        own = np.asarray(mesh.vertices, dtype=np.float64)
        if collision.origin is not None:
            own = own @ collision.origin[:3, :3].T + collision.origin[:3, 3]
        points.append(own)
        triangles.append(np.asarray(mesh.faces, dtype=np.int64) + count)
        count += len(own)
    return np.concatenate(points), np.concatenate(triangles)


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


__all__ = ["Robot", "load"]
