"""Motions as files: a series for ParaView, which is also read, or an animated scene in USD or glTF."""

# names of pxr are made when it is loaded
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import base64
import errno
import json
import os
import struct
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import FloatArray, IntArray, check_mesh, float_array, to_numpy, to_path
from diffvbd.mesh.io import load, read_points
from diffvbd.mesh.tet_mesh import TetMesh
from diffvbd.mesh.write import checked_fields, content_of, quiet, replace, vtu_names

USD = (".usd", ".usda", ".usdc")
GLTF = (".glb", ".gltf")
EXTENSIONS = (".pvd", *USD, *GLTF)


def write_series(
    path: str | PathLike[str],
    mesh: TetMesh,
    frames: Any,
    times: Any = None,
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
) -> None:
    """File of a motion; the extension tells for which program.

    * .pvd, for ParaView: the tets, as `path` and one file `<stem>_<k>.vtu` for each frame next to it.
    * .usdc, .usd (binary) and .usda (text): the surface of each body as a `Mesh` of its own with points that change in
      time. Needs the extra: `pip install diffvbd[exchange]`.
    * .glb (binary) and .gltf (text): the surface of each body with one morph target for each frame after the first, and
      an animation that blends from one to the next. Its weights take 4 N^2 bytes: meant for some hundred frames.

    USD and glTF store positions in single precision. Both are told that y points up and that units are metres.

    Args:
        path: The file.
        mesh: The mesh whose tets connect the frames.
        frames: Positions [m], shape [N, V, 3]; array or tensor.
        times: Time of each frame [s], shape [N], never decreasing; default 0, 1, 2, ... In USD and glTF they increase,
            and in glTF they begin at 0 or later.
        point_data: Further values per vertex by name, shape [N, V] or [N, V, C]. USD has them as primvars; those named
            `velocities` [m/s], shape [N, V, 3], as the velocities of the points. glTF has no place for them.
        cell_data: Values per tet by name, shape [N, T] or [N, T, C]; .pvd only.

    Raises:
        TypeError, ValueError: wrong shape or dtype, NaN or Inf, times in another order, another extension, values that
            the format has no place for, a mesh without tets.
        ImportError: USD, and usd-core is not installed.
        FileNotFoundError: the directory does not exist.

    Source: OpenUSD's schema UsdGeomMesh; Khronos, "glTF 2.0 Specification", 2021, section 3.7.2.2, morph targets.
    """
    path = to_path("path", path)
    check_mesh(mesh)
    extension = check_extension(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"directory {path.parent} does not exist")
    if mesh.num_tets == 0:
        raise ValueError("mesh: expected at least one tet to write, got none")
    # a file has no gradients: those of frames are let go
    positions = float_array("frames", to_numpy("frames", frames), (None, mesh.num_vertices, 3))
    moments = np.arange(len(positions)) if times is None else float_array("times", times, (len(positions),))
    if (np.diff(moments) < 0).any():
        raise ValueError("times: expected times that never decrease")
    of_vertices = checked_fields("point_data", point_data, positions.shape[:2])
    of_tets = checked_fields("cell_data", cell_data, (len(positions), mesh.num_tets))
    if extension == ".pvd":
        _write_pvd(path, mesh, positions, moments, of_vertices, of_tets)
        return
    if of_tets:
        raise ValueError(f"cell_data: expected none, because {extension} files get surfaces; .pvd holds values of tets")
    if len(positions) == 0:
        raise ValueError(f"frames: expected at least one frame for {extension}, got none")
    if (np.diff(moments) <= 0).any():
        raise ValueError(f"times: expected increasing times for {extension}, got two that are equal")
    if extension in USD:
        replace(path, lambda new: write_usd(new, parts_of(mesh), positions, moments, of_vertices))
        return
    if of_vertices:
        raise ValueError(f"point_data: expected none, because {extension} files hold no values that change in time")
    replace(path, lambda new: write_gltf(new, parts_of(mesh), positions, moments))


def check_extension(path: Path, name: str = "path") -> str:
    """The extension of a motion that can be written here: a ValueError names the argument, an ImportError the extra."""
    extension = path.suffix.lower()
    if extension not in EXTENSIONS:
        raise ValueError(f"{name}: expected a name that ends in {', '.join(EXTENSIONS)}, got {path.name!r}")
    if extension in USD:
        require_usd(extension)
    return extension


def _write_pvd(path: Path, mesh: TetMesh, positions: FloatArray, times: NDArray[Any],
               point_data: Mapping[str, NDArray[Any]], cell_data: Mapping[str, NDArray[Any]]) -> None:  # fmt: skip
    digits = max(4, len(str(len(positions) - 1)))
    entries = []
    for k, (time, points) in enumerate(zip(times, positions, strict=True)):
        name = f"{path.stem}_{k:0{digits}d}.vtu"
        fields = (vtu_names({key: rows[k] for key, rows in data.items()}) for data in (point_data, cell_data))
        content = content_of(mesh, points, *fields)
        target = path.with_name(name)
        quiet(lambda content=content, target=target: replace(target, content.write), f"write {target}")
        entries.append(f'    <DataSet timestep="{time:.17g}" part="0" file={quoteattr(name)}/>\n')
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
    collection = "".join([head, *entries, "  </Collection>\n</VTKFile>\n"])
    replace(path, lambda new: new.write_text(collection, encoding="utf-8"))


class Part(NamedTuple):
    """The surface of one body: its name, the vertices of the mesh on it [P], triangles [F, 3] that count those."""

    name: str
    vertices: IntArray
    triangles: IntArray


def parts_of(mesh: TetMesh) -> list[Part]:
    """The surface of each body, in the order of the labels: `body`, or `body_<label>` where there are several."""
    surface = mesh.surface
    labels = mesh.body[surface[:, 0]]
    order = np.argsort(labels, kind="stable")
    found, starts = np.unique(labels[order], return_index=True)
    parts = []
    for label, rows in zip(found.tolist(), np.split(order, starts[1:]), strict=True):
        vertices, triangles = np.unique(surface[rows], return_inverse=True)
        # names of USD have letters, digits and underscores
        name = "body" if len(found) == 1 else f"body_{label}".replace("-", "_")
        parts.append(Part(name, vertices, triangles.reshape(-1, 3)))
    return parts


# Names of the specification's numbers.
FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
TRIANGLES = 4
MOST_BYTES = 2**32 - 2**20  # a .glb counts its bytes in 32 bits; some are left for the JSON


class _Buffer:
    """The bytes of a file, and what it says of them."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.length = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, values: NDArray[Any], **more: Any) -> int:
        """Append an array whose entries take four bytes each, so that all that follows is aligned."""
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": values.nbytes, **more})
        self.pieces.append(values.tobytes())
        self.length += values.nbytes
        return len(self.views) - 1

    def accessor(self, view: int, values: NDArray[Any], offset: int = 0, bounds: bool = False) -> int:
        """Describe an array [n] or [n, 3] that begins at an offset [bytes] of a view."""
        kind = "SCALAR" if values.ndim == 1 else "VEC3"
        component = FLOAT if values.dtype == np.float32 else UNSIGNED_INT
        entry = {"bufferView": view, "byteOffset": offset, "componentType": component, "count": len(values)}
        self.accessors.append({**entry, "type": kind})
        if bounds:
            # of float32: JSON then has the digits of what is stored
            low, high = (np.atleast_1d(edge(values, axis=0)).tolist() for edge in (np.min, np.max))
            self.accessors[-1].update(min=low, max=high)
        return len(self.accessors) - 1


def write_gltf(path: Path, parts: Sequence[Part], frames: FloatArray, times: NDArray[Any]) -> None:
    """Write parts whose vertices move; frames [N, V, 3] m, times [N] s, increasing.

    Raises:
        ValueError: a time below 0, times that single precision cannot tell apart, more bytes than a file can have.
    """
    moments = times.astype(np.float32)
    if times[0] < 0:
        raise ValueError(f"times: expected times of 0 or more for {path.suffix}, got {times[0]:.6g}")
    if (np.diff(moments) <= 0).any():
        raise ValueError(f"times: expected times that float32 can tell apart for {path.suffix}, got closer ones")
    size = 4 * len(frames) ** 2 + sum(12 * (len(frames) * len(p.vertices) + len(p.triangles)) for p in parts)
    if size > MOST_BYTES:
        raise ValueError(f"frames: expected a motion of at most {MOST_BYTES} bytes for {path.suffix}, got {size}")
    buffer = _Buffer()
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "diffvbd"},
        "scene": 0,
        "scenes": [{"nodes": [*range(len(parts))]}],
        "nodes": [{"name": part.name, "mesh": k} for k, part in enumerate(parts)],
        "meshes": [_mesh(buffer, part, frames) for part in parts],
    }
    if len(frames) > 1:
        content["animations"] = [_animation(buffer, len(parts), moments)]
    content |= {"accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": buffer.length}]}
    data = b"".join(buffer.pieces)
    if path.suffix.lower() == ".gltf":
        content["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        path.write_text(json.dumps(content), encoding="utf-8")
    else:
        path.write_bytes(_binary(content, data))


def _mesh(buffer: _Buffer, part: Part, frames: FloatArray) -> dict[str, Any]:
    """A mesh at the first frame, and how far it is from there in each later one."""
    triangles = part.triangles.ravel().astype(np.uint32)
    indices = buffer.accessor(buffer.view(triangles, target=ELEMENT_ARRAY_BUFFER), triangles)
    here = frames[:, part.vertices]
    shapes = here.astype(np.float32)
    # What the first frame lost to rounding is not lost again in the others.
    shapes[1:] = here[1:] - shapes[0].astype(np.float64)
    view = buffer.view(shapes, byteStride=12, target=ARRAY_BUFFER)
    at = [buffer.accessor(view, shape, k * shape.nbytes, bounds=True) for k, shape in enumerate(shapes)]
    primitive: dict[str, Any] = {"attributes": {"POSITION": at[0]}, "indices": indices, "mode": TRIANGLES}
    mesh: dict[str, Any] = {"name": part.name, "primitives": [primitive]}
    if len(at) > 1:
        primitive["targets"] = [{"POSITION": accessor} for accessor in at[1:]]
        mesh["weights"] = [0.0] * (len(at) - 1)
    return mesh


def _animation(buffer: _Buffer, parts: int, times: NDArray[np.float32]) -> dict[str, Any]:
    """At time k the weight of target k is 1 and all others are 0; between times weights are blended."""
    weights = np.eye(len(times), len(times) - 1, k=-1, dtype=np.float32).ravel()
    sampler = {
        "input": buffer.accessor(buffer.view(times), times, bounds=True),
        "interpolation": "LINEAR",
        "output": buffer.accessor(buffer.view(weights), weights),
    }
    targets = [{"node": node, "path": "weights"} for node in range(parts)]
    return {"name": "motion", "samplers": [sampler], "channels": [{"sampler": 0, "target": t} for t in targets]}


def _binary(content: dict[str, Any], data: bytes) -> bytes:
    """A .glb: a header, then JSON and data, each padded to four bytes."""
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    length = 12 + 8 + len(text) + 8 + len(data)
    parts = (b"glTF", struct.pack("<III", 2, length, len(text)), b"JSON", text, struct.pack("<I", len(data)), b"BIN\0")
    return b"".join(parts) + data


ROOT = "/simulation"
RATE = 24.0  # frames per second of a single frame


def write_usd(
    path: Path, parts: Sequence[Part], frames: FloatArray, times: NDArray[Any], point_data: Mapping[str, NDArray[Any]]
) -> None:
    """Write parts whose vertices move; frames [N, V, 3] m, times [N] s, increasing, point_data [N, V] or [N, V, C].

    Raises:
        ValueError: `velocities` of another shape than [N, V, 3].
        ImportError: usd-core is not installed.
    """
    require_usd(path.suffix)
    from pxr import Sdf, Tf, Usd, UsdGeom, Vt

    velocities = point_data.get("velocities")
    if velocities is not None and velocities.shape != frames.shape:
        shape = list(frames.shape)
        raise ValueError(f"point_data['velocities']: expected shape {shape}, got {list(velocities.shape)}")
    rate = (len(times) - 1) / float(times[-1] - times[0]) if len(times) > 1 else RATE
    codes = np.round(times * rate, 6).tolist()  # whole numbers where frames are even
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())

    def vectors(values: NDArray[Any]) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))

    for part in parts:
        surface = UsdGeom.Mesh.Define(stage, f"{ROOT}/{part.name}")
        surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        surface.CreateFaceVertexCountsAttr(Vt.IntArray(len(part.triangles), 3))
        surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(part.triangles.ravel().astype(np.int32)))
        points, extent = surface.CreatePointsAttr(), surface.CreateExtentAttr()
        moving = surface.CreateVelocitiesAttr() if velocities is not None else None
        further = [
            (_primvar(surface, Sdf, UsdGeom, name, values), values, values.ndim == 3 and values.shape[2] == 3)
            for name, values in point_data.items()
            if name != "velocities"
        ]
        for k, code in enumerate(codes):
            here = frames[k, part.vertices]
            points.Set(vectors(here), code)
            extent.Set(vectors(np.stack([here.min(0), here.max(0)])), code)
            if moving is not None and velocities is not None:
                moving.Set(vectors(velocities[k, part.vertices]), code)
            for primvar, values, is_vector in further:
                rows = values[k, part.vertices]
                flat = np.ascontiguousarray(rows.ravel(), dtype=np.float32)
                primvar.Set(vectors(rows) if is_vector else Vt.FloatArray.FromNumpy(flat), code)
    try:
        written = stage.GetRootLayer().Export(str(path))
    except Tf.ErrorException:
        written = False
    if not written:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))  # USD does not say which error it was


def require_usd(extension: str) -> None:
    """Raises ImportError that names the extra, where usd-core is not installed."""
    try:
        import pxr.UsdGeom  # noqa: F401
    except ImportError:
        raise ImportError(f"writing {extension} needs usd-core: pip install 'diffvbd[exchange]'") from None


def _primvar(surface: Any, sdf: Any, usd_geom: Any, name: str, values: NDArray[Any]) -> Any:
    """An attribute of vertices: floats, vectors where C = 3, or arrays of C floats each."""
    columns = values.shape[2] if values.ndim == 3 else 1
    kind = sdf.ValueTypeNames.Vector3fArray if columns == 3 else sdf.ValueTypeNames.FloatArray
    try:
        primvar = usd_geom.PrimvarsAPI(surface).CreatePrimvar(name, kind, usd_geom.Tokens.vertex)
    except Exception:
        primvar = None
    if not primvar:
        raise ValueError(f"point_data: expected names of letters, digits and underscores for USD, got {name!r}")
    if columns not in (1, 3):
        primvar.SetElementSize(columns)
    return primvar


class Frames(NamedTuple):
    """A series: the mesh of the first frame, positions [N, V, 3] m and times [N] s."""

    mesh: TetMesh
    points: FloatArray
    times: FloatArray


def read_frames(path: Path) -> Frames:
    """The frames of a .pvd file.

    Raises:
        FileNotFoundError: the file or a frame is not there.
        ValueError: not a .pvd file, no frames, or frames of different meshes.
    """
    if not path.is_file():
        raise FileNotFoundError(f"series {path} does not exist")
    try:
        sets = ElementTree.parse(path).getroot().findall("./Collection/DataSet")
        listed = [(float(each.attrib["timestep"]), path.parent / each.attrib["file"]) for each in sets]
    except (ElementTree.ParseError, KeyError, ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"series {path}: expected a .pvd collection with timesteps and files, got {error}") from None
    if not listed:
        raise ValueError(f"series {path}: expected at least one frame, got none")
    listed.sort(key=lambda entry: entry[0])
    mesh, vertices = load(listed[0][1], return_vertices=True, weld=0)
    points = [mesh.points]
    for _, file in listed[1:]:
        frame = read_points(file)
        if vertices.max() >= len(frame):
            wanted = f"frames of {mesh.num_vertices} vertices"
            raise ValueError(f"series {path}: expected {wanted}, got {len(frame)} in {file}")
        points.append(frame[vertices])
    return Frames(mesh, np.stack(points), np.array([moment for moment, _ in listed]))
