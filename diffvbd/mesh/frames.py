"""Reading a series of frames: the .pvd that `write_series` and ParaView write."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from diffvbd.mesh.arrays import FloatArray
from diffvbd.mesh.io import load, read_points
from diffvbd.mesh.tet_mesh import TetMesh


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
            raise ValueError(
                f"series {path}: expected frames of {mesh.num_vertices} vertices, got {len(frame)} in {file}"
            )
        points.append(frame[vertices])
    return Frames(mesh, np.stack(points), np.array([moment for moment, _ in listed]))
