"""Mesh files by the reader that knows them: meshio, trimesh for surfaces, our own for TetGen.

No reader tells what it has left out, and some never end on a truncated file: counts in headers are held against what
arrives, and text is read through a file that ends once.
"""

from __future__ import annotations

import io
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh import headers
from diffvbd.mesh.arrays import IntArray
from diffvbd.mesh.tetgen import read_tetgen
from diffvbd.mesh.write import PREFERRED_FORMAT, quiet

SURFACES = (".obj", ".off", ".ply", ".stl")  # of these meshio loses or refuses too much; they hold no tets
# What meshio reads from an open file; some of these readers wait for a word that a truncated file does not have.
_TEXT = ("abaqus", "avsucd", "medit", "nastran", "netgen", "permas", "su2", "tecplot")
_BYTES = ("mdpa",)


def read_cells(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A mesh file as meshio has it, and what a user should know of what was not read.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no reader knows it, it ends too early, or what arrived is not what its header names.
        ImportError: the format needs a package that is not installed.
    """
    _check_is_file(path)
    warned: list[str] = []
    content, notes = quiet(lambda: _read_cells(path), f"read {path}", warned)
    return content, notes + warned


def read_surface(path: Path) -> tuple[NDArray[Any], IntArray]:
    """Points [P, 3] and triangles [F, 3] of one of SURFACES; faces of more corners are cut. Raises as `read_cells`."""
    _check_is_file(path)
    try:
        import trimesh
    except ImportError:
        raise ImportError(f"reading {path.suffix} needs trimesh: pip install 'diffvbd[mesh]'") from None

    def action() -> tuple[NDArray[Any], IntArray]:
        named = headers.faces(path)
        data, kind = path.read_bytes(), path.suffix.lower()[1:]
        if kind == "obj":  # trimesh makes vertices for each material, texture coordinate and normal
            lines = re.findall(rb"^[ \t]*[vf][ \t].*$", re.sub(rb"\\\r?\n", b" ", data), re.M)
            data = re.sub(rb"(?<=\d)/\S*", b"", b"\n".join(lines))
        found = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False)
        triangles = np.asarray(found.faces, dtype=np.int64).reshape(-1, 3)
        if named is not None and len(triangles) < named:
            raise meshio.ReadError(
                f"it has {named} faces, and the reader found {len(triangles)}: truncated, or not written as usual"
            )
        return np.asarray(found.vertices), triangles

    return quiet(action, f"read {path}")


def _check_is_file(path: Path) -> None:
    if not path.is_file():
        raise FileNotFoundError(
            f"mesh file {path} is not a file" if path.exists() else f"mesh file {path} does not exist"
        )


def _read_cells(path: Path) -> tuple[meshio.Mesh, list[str]]:
    kind = _kind(path)
    if kind == "tetgen":
        return read_tetgen(path), []
    named = headers.counts(path, kind)
    content, notes = _read_msh(path) if kind == "gmsh" else (_read_as(kind, path), [])
    nodes, cells = len(content.points), sum(len(block.data) for block in content.cells)
    if named.nodes is not None and nodes != named.nodes:
        raise meshio.ReadError(f"it names {named.nodes} nodes, and the reader found {nodes}")
    if named.cells is not None and cells < named.cells:
        notes.append(f"{named.cells - cells} of its {named.cells} cells are of kinds that the reader does not know")
    return content, notes


def _kind(path: Path) -> str:
    """What meshio calls the format."""
    suffix = path.suffix.lower()
    if suffix == ".vtk":
        with path.open("rb") as file:
            return "vtu" if file.read(64).lstrip()[:1] == b"<" else "vtk"  # SOFA names .vtu so
    if suffix in PREFERRED_FORMAT:
        return PREFERRED_FORMAT[suffix]
    known = meshio.extension_to_filetypes.get("".join(path.suffixes[-2:]).lower())
    known = known or meshio.extension_to_filetypes.get(suffix)
    if not known:
        raise meshio.ReadError(f"no reader knows files that end in {suffix or 'nothing'}")
    return known[0]


def _read_as(kind: str, path: Path) -> meshio.Mesh:
    if kind == "abaqus":
        text = path.read_text(encoding="utf-8", errors="replace")
        merged = headers.abaqus_text(text)
        if merged is not text:
            return meshio.read(io.StringIO(merged), kind)
    if kind in _TEXT and path.suffix.lower() not in (".gz", ".meshb"):
        with _Text(path.open("rb"), encoding="utf-8", errors="replace") as file:
            return meshio.read(file, kind)
    if kind in _BYTES:
        with _Bytes(path.open("rb", buffering=0)) as file:
            return meshio.read(file, kind)
    return meshio.read(path, kind)


def _read_msh(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A Gmsh file. meshio fails where only some volumes have groups, on partitions, and on the versions 1 and 4.0; what
    it fails on is read again without all but nodes and elements, in words that it knows."""
    data = path.read_bytes()
    version = headers.msh_version(data)
    if version == "1":
        return _read_copy(_of_version_1(data)), []
    if version == "4":  # Gmsh's own name of 4.0; meshio takes it for 4.1
        data = re.sub(rb"\$MeshFormat\s+4 ", b"$MeshFormat\n4.0 ", data, count=1)
    try:
        return _read_copy(data) if version == "4" else meshio.read(path, "gmsh"), []
    except Exception as failure:
        sections = rb"^\$(MeshFormat|Nodes|Elements)[ \t]*\r?\n.*?\$End\1"
        kept = list(re.finditer(sections, data, re.M | re.S))
        if [part.group(1) for part in kept] != [b"MeshFormat", b"Nodes", b"Elements"]:
            raise
        try:
            content = _read_copy(b"\n".join(part.group() for part in kept) + b"\n")
        except Exception:
            raise failure from None
        return content, ["the reader knows neither its groups nor its values, which are left out"]


def _of_version_1(data: bytes) -> bytes:
    """Format 1 in the words of format 2.2."""
    lines = data.decode(errors="replace").splitlines()
    inside, out = False, ["$MeshFormat", "2.2 0 8", "$EndMeshFormat"]
    names = {"$NOD": "$Nodes", "$ENDNOD": "$EndNodes", "$ELM": "$Elements", "$ENDELM": "$EndElements"}
    for line in lines:
        words = line.split()
        if inside and len(words) > 4:  # number, kind, group, entity, how many nodes, the nodes
            line = " ".join([*words[:2], "2", *words[2:4], *words[5:]])
        inside = (inside or line.strip() == "$ELM") and line.strip() != "$ENDELM"
        out.append(names.get(line.strip(), line))
    return "\n".join([*out, ""]).encode()


def _read_copy(data: bytes) -> meshio.Mesh:
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "copy.msh"
        copy.write_bytes(data)
        return meshio.read(copy, "gmsh")


def _once(readline: Callable[..., Any]) -> Callable[..., Any]:
    """readline of a file that raises where a reader keeps on asking beyond the end."""

    def asked(self: Any, size: int = -1) -> Any:
        line = readline(self, size)
        self.ends = 0 if line else self.ends + 1
        if self.ends > 100:
            raise EOFError("the file ends within a block")
        return line

    return asked


class _Text(io.TextIOWrapper):
    ends = 0
    readline = _once(io.TextIOWrapper.readline)


class _Bytes(io.BufferedReader):
    ends = 0
    readline = _once(io.BufferedReader.readline)
