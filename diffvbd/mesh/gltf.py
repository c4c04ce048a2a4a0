"""Moving surfaces as glTF 2.0: a morph target for each frame.

Written here, because no library does it: trimesh writes neither morph targets nor animations, and pygltflib gives names
to JSON's keys but leaves the bytes, which are all the work, to its caller.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import FloatArray
from diffvbd.mesh.parts import Part

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
    if len(at) == 1:
        return {"name": part.name, "primitives": [primitive]}
    primitive["targets"] = [{"POSITION": accessor} for accessor in at[1:]]
    return {"name": part.name, "primitives": [primitive], "weights": [0.0] * (len(at) - 1)}


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
