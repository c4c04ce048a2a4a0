"""Claim: a viewer that follows the glTF specification shows the motion that was written."""

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from diffvbd import mesh as dm
from diffvbd.testing import tolerance

MESH = dm.join([dm.bunny(8), dm.cube(3)])
TIMES = np.array([0.0, 0.01, 0.03, 0.06])
FRAMES = MESH.points + np.sin(40 * TIMES[:, None, None] + MESH.points)
TYPES = {5126: np.float32, 5125: np.uint32}
COLUMNS = {"SCALAR": 1, "VEC3": 3}


def opened(path: Path) -> tuple[dict[str, Any], bytes]:
    """JSON and bytes of a file, by the text of the specification."""
    if path.suffix == ".gltf":
        content = json.loads(path.read_text(encoding="utf-8"))
        return content, base64.b64decode(content["buffers"][0]["uri"].split(",")[1])
    raw = path.read_bytes()
    magic, version, length, first, kind = struct.unpack_from("<4sII I4s", raw)
    assert (magic, version, length, kind) == (b"glTF", 2, len(raw), b"JSON") and first % 4 == 0
    second, kind = struct.unpack_from("<I4s", raw, 20 + first)
    assert kind == b"BIN\0" and 28 + first + second == len(raw)
    return json.loads(raw[20 : 20 + first]), raw[28 + first :]


def opened_by_pygltflib(path: Path) -> tuple[dict[str, Any], bytes]:
    pygltflib = pytest.importorskip("pygltflib", reason="needs pygltflib, which the extra [dev] has")
    file = pygltflib.GLTF2().load(str(path))
    data = file.binary_blob() or file.get_data_from_buffer_uri(file.buffers[0].uri)
    return json.loads(file.to_json()), data


def array(content: dict[str, Any], data: bytes, index: int) -> np.ndarray:
    entry = content["accessors"][index]
    view = content["bufferViews"][entry["bufferView"]]
    columns, dtype = COLUMNS[entry["type"]], TYPES[entry["componentType"]]
    start = view["byteOffset"] + entry["byteOffset"]
    assert start % 4 == 0 and entry["byteOffset"] + 4 * columns * entry["count"] <= view["byteLength"]
    values = np.frombuffer(data, dtype, columns * entry["count"], start).reshape(-1, columns)
    if "min" in entry:
        assert np.array_equal(entry["min"], values.min(0)) and np.array_equal(entry["max"], values.max(0))
    return values if columns > 1 else values[:, 0]


def shown(content: dict[str, Any], data: bytes, time: float) -> list[np.ndarray]:
    """Triangles [F, 3, 3] of each node at a time: base and targets by the weights that the animation has there."""
    nodes = content["nodes"]
    weights = {k: content["meshes"][node["mesh"]].get("weights", []) for k, node in enumerate(nodes)}
    for animation in content.get("animations") or []:
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            moments, rows = (array(content, data, sampler[key]) for key in ("input", "output"))
            rows = rows.reshape(len(moments), -1)
            assert sampler["interpolation"] == "LINEAR" and channel["target"]["path"] == "weights"
            weights[channel["target"]["node"]] = [np.interp(time, moments, column) for column in rows.T]
    bodies = []
    for k in content["scenes"][content["scene"]]["nodes"]:
        (primitive,) = content["meshes"][nodes[k]["mesh"]]["primitives"]
        points = array(content, data, primitive["attributes"]["POSITION"]).astype(np.float64)
        targets = primitive.get("targets") or []
        for weight, target in zip(weights[k], targets, strict=True):
            points = points + weight * array(content, data, target["POSITION"])
        faces = array(content, data, primitive["indices"]).reshape(-1, 3)
        assert faces.max() + 1 == len(points) and primitive["mode"] == 4
        bodies.append(points[faces])
    return bodies


@pytest.mark.parametrize("extension", ["glb", "gltf"])
@pytest.mark.parametrize("reader", [opened, opened_by_pygltflib])
def test_viewer_shows_the_frames_and_blends_between_them(tmp_path: Path, extension: str, reader: Any) -> None:
    path = tmp_path / f"motion.{extension}"
    dm.write_series(path, MESH, FRAMES, TIMES)
    content, data = reader(path)
    assert [node["name"] for node in content["nodes"]] == ["body_0", "body_1"]
    middle = (FRAMES[1] + FRAMES[2]) / 2
    for time, frame in [*zip(TIMES, FRAMES, strict=True), (0.02, middle)]:
        for label, triangles in enumerate(shown(content, data, time)):
            wanted = frame[MESH.surface[MESH.body[MESH.surface[:, 0]] == label]]
            np.testing.assert_allclose(triangles, wanted, rtol=0, atol=2 * tolerance("stored_float32"))


def test_trimesh_reads_the_first_frame(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh, which the extra [dev] has")
    dm.write_series(tmp_path / "a.glb", MESH, FRAMES[:1])
    scene = trimesh.load(tmp_path / "a.glb")
    for label, body in enumerate((dm.bunny(8), dm.cube(3))):
        found = scene.geometry[f"body_{label}"]
        assert found.is_watertight and len(found.faces) == len(body.surface)


def test_one_frame_does_not_move(tmp_path: Path) -> None:
    dm.write_series(tmp_path / "a.gltf", dm.cube(), dm.cube().points[None])
    content, data = opened(tmp_path / "a.gltf")
    assert "animations" not in content and "targets" not in content["meshes"][0]["primitives"][0]
    assert np.array_equal(shown(content, data, 0.0)[0], dm.cube().points[dm.cube().surface])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"times": [-0.1, 0.0, 0.1, 0.2]}, "times: expected times of 0 or more for .glb, got -0.1"),
        ({"times": [0.0, 0.1, 0.1, 0.2]}, "times: expected increasing times for .glb, got two that are equal"),
        ({"times": [0.0, 1e9, 1e9 + 1, 2e9]}, "times: expected times that float32 can tell apart for .glb"),
        ({"frames": FRAMES[:0]}, "frames: expected at least one frame for .glb, got none"),
        ({"point_data": {"s": FRAMES}}, "point_data: expected none, because .glb files hold no values"),
        (
            {"cell_data": {"s": np.zeros((4, MESH.num_tets))}},
            "cell_data: expected none, because .glb files get surfaces",
        ),
    ],
)
def test_bad_motions_write_nothing(tmp_path: Path, arguments: dict, says: str) -> None:
    given = {"frames": FRAMES, "times": None if "frames" in arguments else TIMES, **arguments}
    with pytest.raises(ValueError, match=says):
        dm.write_series(tmp_path / "a.glb", MESH, **given)
    assert not list(tmp_path.iterdir())
