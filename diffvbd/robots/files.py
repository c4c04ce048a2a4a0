"""Robots of files: URDF by yourdfpy, MJCF by mujoco's own parser; shapes by trimesh."""

from __future__ import annotations

import importlib
import math
import tempfile
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .._common.checks import fail, real_array
from .robot import Description, Joint, Robot

TYPES = {"revolute": "turns", "continuous": "turns", "prismatic": "slides", "fixed": "fixed"}  # of URDF
ROUND = 16  # corners of the circle of a cylinder
FREE = (-math.inf, math.inf)
Surface = tuple[NDArray[np.float64], NDArray[np.int64]]


def load(path: str | PathLike[str], base: Tensor | None = None) -> Robot:
    """A robot of a URDF file, or of an MJCF file (``.xml``), with the collision shapes of its links.

    Boxes, cylinders, spheres, capsules, ellipsoids and meshes become triangles; the shapes of a link one Obstacle.

    Args:
        path: The file. Meshes are looked for beside it, as yourdfpy and mujoco do.
        base: Pose of the root link in the world [4, 4]; None: the identity.

    Raises:
        FileNotFoundError: Without such a file.
        ImportError: Without yourdfpy or, for MJCF, mujoco.
        ValueError: For another file, one without collision shapes, or a mesh that is not there; for joints with more
            than one freedom, as ball and free joints; for planes and height fields, which a Model has colliders of its
            own for; for a base that is no pose.
    """
    with open(path, "rb"):  # the error of a missing file names it
        pass
    like = torch.eye(4, dtype=torch.float64)
    pose = like if base is None else real_array("base", base, "a pose [4, 4]").detach().to(like)
    turn = pose[:3, :3] if pose.shape == (4, 4) else 0 * like[:3, :3]
    is_turn = torch.allclose(turn @ turn.mT, like[:3, :3], atol=1e-6) and float(torch.linalg.det(turn)) > 0
    if not is_turn or not torch.equal(pose[3], like[3]):
        fail("base", "a pose [4, 4]: a rotation, a translation, and 0, 0, 0, 1", pose.tolist())
    of_mjcf = fspath(path).lower().endswith(".xml")
    return Robot((_mjcf if of_mjcf else _urdf)(fspath(path)), pose)


def loads(text: str, base: Tensor | None = None) -> Robot:
    """A robot of the text of a URDF or MJCF file without meshes; otherwise as :func:`load`."""
    if not isinstance(text, str):
        raise TypeError(f"text: expected a str, got {type(text).__name__}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / ("robot.xml" if "<mujoco" in text else "robot.urdf")
        file.write_text(text, encoding="utf-8")
        return load(file, base)


# --- URDF -------------------------------------------------------------------------------------------------------------


def _urdf(path: str) -> Description:
    try:
        from yourdfpy import URDF
    except ImportError:
        raise ImportError("robots: expected yourdfpy, which is not installed: pip install 'diffvbd[robots]'") from None
    try:
        urdf = URDF.load(path, build_scene_graph=False, load_meshes=False)
    except Exception as error:  # of its parser
        raise ValueError(f"path: expected a URDF file, got {path!r} ({error})") from error
    links = urdf.robot.links
    surfaces = {
        link.name: _joined([_shape_of_urdf(urdf, c) for c in link.collisions]) for link in links if link.collisions
    }
    return Description([link.name for link in links], [_joint_of_urdf(j) for j in urdf.robot.joints], surfaces)


def _joint_of_urdf(joint: Any) -> Joint:
    if joint.type not in TYPES:
        fail("path", f"joints of the types {', '.join(TYPES)}", f"{joint.name!r}, which is {joint.type}")
    limits, mimic = FREE, joint.mimic
    if joint.limit is not None and joint.type != "continuous":
        lower, upper = (0.0 if value is None else float(value) for value in (joint.limit.lower, joint.limit.upper))
        limits = (lower, upper)
    follows = (joint.name, 1.0, 0.0)
    if mimic is not None:
        follows = (mimic.joint, 1.0 if mimic.multiplier is None else mimic.multiplier, mimic.offset or 0.0)
    origin = np.eye(4) if joint.origin is None else joint.origin
    axis = np.array([1.0, 0.0, 0.0]) if joint.axis is None else joint.axis
    return Joint(joint.name, TYPES[joint.type], joint.parent, joint.child, origin, axis, limits, *follows)  # type: ignore


def _shape_of_urdf(urdf: Any, collision: Any) -> Surface:
    import trimesh

    shape, mesh = collision.geometry, None
    if shape.box is not None:
        mesh = trimesh.creation.box(shape.box.size)
    elif shape.cylinder is not None:
        mesh = trimesh.creation.cylinder(shape.cylinder.radius, shape.cylinder.length, sections=ROUND)
    elif shape.sphere is not None:
        mesh = trimesh.creation.icosphere(2, shape.sphere.radius)
    else:
        try:
            mesh = trimesh.load(urdf._filename_handler(shape.mesh.filename), force="mesh")
        except Exception as error:  # of its many readers
            raise ValueError(
                f"path: expected a mesh that can be read, got {shape.mesh.filename!r} ({error})"
            ) from error
        if shape.mesh.scale is not None:
            mesh.apply_scale(shape.mesh.scale)
    return _placed(mesh, np.eye(4) if collision.origin is None else collision.origin)


# --- MJCF -------------------------------------------------------------------------------------------------------------


def _mjcf(path: str) -> Description:
    try:
        mujoco: Any = importlib.import_module("mujoco")
    except ImportError:
        raise ImportError("robots: expected mujoco, which is not installed: pip install mujoco") from None
    try:
        m = mujoco.MjModel.from_xml_path(path)
    except ValueError as error:
        raise ValueError(f"path: expected an MJCF file, got {path!r} ({error})") from error
    body, joint = (_named(m, kind) for kind in ("body", "joint"))
    links, joints, shapes = [body(0)], [], {}
    leaders, types = _leaders(m, mujoco, joint), mujoco.mjtJoint
    kinds: dict[int, Any] = {int(types.mjJNT_HINGE): "turns", int(types.mjJNT_SLIDE): "slides"}
    for b in range(1, m.nbody):
        at, parent = _frame(m.body_pos[b], m.body_quat[b]), body(m.body_parentid[b])
        for k in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
            kind = kinds.get(int(m.jnt_type[k]))
            if kind is None:
                fail("path", "joints of the types hinge and slide", f"a ball or free joint of {body(b)!r}")
            limits = tuple(m.jnt_range[k].tolist()) if m.jnt_limited[k] else FREE
            leader, factor, offset = leaders.get(k, (joint(k), 1.0, 0.0))
            child = f"{body(b)}: {joint(k)}"
            joints.append(Joint(joint(k), kind, parent, child, at @ _frame(m.jnt_pos[k]), m.jnt_axis[k], limits, leader,
                                factor, offset - float(m.qpos0[m.jnt_qposadr[k]])))  # fmt: skip
            links.append(child)
            at, parent = _frame(-m.jnt_pos[k]), child
        joints.append(Joint(f"{body(b)}: end", "fixed", parent, body(b), at, np.array([1.0, 0.0, 0.0]), FREE, ""))
        links.append(body(b))
    for g in range(m.ngeom):
        if m.geom_contype[g] or m.geom_conaffinity[g]:
            shapes.setdefault(body(m.geom_bodyid[g]), []).append(_shape_of_mjcf(m, mujoco, g))
    return Description(links, joints, {name: _joined(parts) for name, parts in shapes.items()})


def _named(m: Any, kind: str) -> Any:
    """Names of bodies or joints by their numbers."""
    return lambda number: getattr(m, kind)(int(number)).name or f"{kind} {int(number)}"


def _leaders(m: Any, mujoco: Any, joint: Any) -> dict[int, tuple[str, float, float]]:
    """Joints that an equality makes follow another one, q = c0 + c1 q of that, both without their references."""
    out = {}
    for e in range(m.neq):
        if int(m.eq_type[e]) != int(mujoco.mjtEq.mjEQ_JOINT) or m.eq_obj2id[e] < 0 or not m.eq_active0[e]:
            continue
        one, two, (c0, c1, *others) = int(m.eq_obj1id[e]), int(m.eq_obj2id[e]), m.eq_data[e][:5].tolist()
        if any(others):
            fail("path", "equalities of joints that are linear", f"another of {joint(one)!r}")
        first, second = (float(m.qpos0[m.jnt_qposadr[k]]) for k in (one, two))
        out[one] = (joint(two), c1, first + c0 - c1 * second)
    return out


def _shape_of_mjcf(m: Any, mujoco: Any, g: int) -> Surface:
    import trimesh

    kinds, size = mujoco.mjtGeom, m.geom_size[g]
    kind = kinds(int(m.geom_type[g]))
    at = _frame(m.geom_pos[g], m.geom_quat[g])
    if kind == kinds.mjGEOM_BOX:
        mesh = trimesh.creation.box(2 * size)
    elif kind == kinds.mjGEOM_SPHERE:
        mesh = trimesh.creation.icosphere(2, size[0])
    elif kind == kinds.mjGEOM_ELLIPSOID:
        mesh = trimesh.creation.icosphere(2)
        mesh.apply_scale(size)
    elif kind == kinds.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(size[0], 2 * size[1], sections=ROUND)
    elif kind == kinds.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(2 * size[1], size[0], count=(ROUND, ROUND // 2))
        mesh.vertices[:, 2] -= mesh.bounds.mean(0)[2]
    elif kind == kinds.mjGEOM_MESH:
        k = m.geom_dataid[g]
        vertices = m.mesh_vert[m.mesh_vertadr[k] :][: m.mesh_vertnum[k]]
        mesh = trimesh.Trimesh(vertices, m.mesh_face[m.mesh_faceadr[k] :][: m.mesh_facenum[k]], process=False)
    else:
        fail("path", "collision shapes with a surface", f"a plane or height field of {m.body(m.geom_bodyid[g]).name!r}")
    return _placed(mesh, at)


# --- poses and shapes -------------------------------------------------------------------------------------------------


def _frame(shift: Any, quaternion: Any = (1.0, 0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """Pose [4, 4] of a translation and a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    turn = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, shift
    return out


def _placed(mesh: Any, at: NDArray[np.float64]) -> Surface:
    mesh.merge_vertices()
    points = np.asarray(mesh.vertices, dtype=np.float64) @ at[:3, :3].T + at[:3, 3]
    triangles = np.asarray(mesh.faces, dtype=np.int64)
    one, two = (points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))
    return points, triangles[np.linalg.norm(np.cross(one, two), axis=1) > 0]  # files may have some without an area


def _joined(parts: list[Surface]) -> Surface:
    first = np.cumsum([0, *(len(points) for points, _ in parts)])
    triangles = [own + begin for (_, own), begin in zip(parts, first, strict=False)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(triangles)
