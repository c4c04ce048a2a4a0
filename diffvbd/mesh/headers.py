"""What mesh files say of themselves: their kind, and how many nodes, cells and faces they have."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from meshio import ReadError


class Counts(NamedTuple):
    """How many nodes and cells a file says that it has; None where it does not say."""

    nodes: int | None = None
    cells: int | None = None


def counts(path: Path, kind: str) -> Counts:
    """The numbers of nodes and cells that a file of this kind of meshio names.

    Raises:
        ReadError: more of them than the file has bytes, or several blocks of nodes that cannot be told apart.
    """
    reader = _READERS.get(kind)
    data = path.read_bytes() if reader else b""
    found = reader(data) if reader else Counts()
    for name, number in found._asdict().items():
        if number is not None and number > len(data) and kind != "vtu":  # whose arrays may be compressed
            raise ReadError(f"truncated: it names {number} {name} and has {len(data)} bytes")
    return found


def faces(path: Path) -> int | None:
    """How many faces a surface file names, or has lines for."""
    data, suffix = path.read_bytes(), path.suffix.lower()
    if suffix == ".obj":
        return len(re.findall(rb"^[ \t]*f[ \t]+\S+[ \t]+\S+[ \t]+\S", data, re.M))
    if suffix == ".stl":
        if data[80:84] and (number := struct.unpack("<I", data[80:84].ljust(4))[0]) * 50 + 84 == len(data):
            return number
        text = len(re.findall(rb"^\s*endfacet", data, re.M | re.I))
        if text == 0 and not data[:5].lower() == b"solid":
            raise ReadError(f"truncated: {len(data)} bytes are no binary STL of a whole number of triangles")
        return text
    if suffix == ".off":
        head = re.match(rb"\s*\w*OFF\w*\s+(?:#[^\n]*\s+)*(\d+)\s+(\d+)", data)
    else:
        end = data.find(b"end_header")
        if end < 0:
            raise ReadError("truncated: its header has no end")
        head = re.search(rb"element\s+(face)\s+(\d+)", data[:end])
    return int(head.group(2)) if head else None


def msh_version(data: bytes) -> str:
    """'2.2', '4', '4.1', ... of a Gmsh file, '1' of the oldest.

    Raises:
        ReadError: it is none.
    """
    head = re.match(rb"\s*(?:\$Comments.*?\$EndComments\s*)?(\$MeshFormat\s+([\d.]+)|\$NOD\s)", data, re.S)
    if head:
        return head.group(2).decode() if head.group(2) else "1"
    if data.lstrip()[:1] == b"(":
        raise ReadError("it is a mesh of Ansys Fluent, which has faces and no tets: export one of Gmsh or VTK")
    shown = data[:40].split(b"\n")[0].decode(errors="replace").strip()
    raise ReadError(f"expected a Gmsh file, which begins with $MeshFormat or $NOD, got {shown!r}")


def _msh(data: bytes) -> Counts:
    version = msh_version(data)
    if version == "1":
        heads = (re.findall(rb"^\$%s\s+(\d+)" % name, data, re.M) for name in (b"NOD", b"ELM"))
        return Counts(*(_only(found, "sections of one kind") for found in heads))
    binary = re.match(rb"\s*\$MeshFormat\s+\S+\s+1", data) is not None
    found = []
    for name in (b"Nodes", b"Elements"):
        sections = [m.end() for m in re.finditer(rb"^\$%s[ \t]*\r?\n" % name, data, re.M)]
        if len(sections) > 1:
            raise ReadError(f"it has {len(sections)} sections ${name.decode()}, whose numbers cannot be told apart")
        if not sections:
            found.append(None)
        elif version.startswith("4") and binary:
            words = data[sections[0] : sections[0] + 32]
            found.append(struct.unpack("<4Q", words) if len(words) == 32 else (0, 0))
        else:
            found.append(tuple(int(word) for word in re.findall(rb"\d+", data[sections[0] :].split(b"\n", 1)[0])))
    if version.startswith("4"):
        for head in found:
            if head and head[0] > len(data):
                raise ReadError(f"truncated: it names {head[0]} blocks and has {len(data)} bytes")
        nodes, cells = (head[1] if head and len(head) > 1 else None for head in found)
        if version != "4" and found[0] and len(found[0]) == 4 and found[0][1] > found[0][3] - found[0][2] + 1:
            raise ReadError("blocks of its nodes have the same numbers, so that they cannot be told apart")
        return Counts(nodes, cells)
    if not binary and found[0]:
        start = data.index(b"\n", data.index(b"$Nodes")) + 1
        _check_numbers(data[start : data.find(b"$EndNodes", start)])
    return Counts(*(head[0] if head else None for head in found))


def _check_numbers(section: bytes) -> None:
    """Raises where two nodes of format 2 have one number."""
    lines = section.split(b"\n")[1:]
    numbers = np.array([line.split(None, 1)[0] for line in lines if line.strip()])
    if len(np.unique(numbers)) < len(numbers):
        raise ReadError("some of its nodes have the same number, so that they cannot be told apart")


def _vtk(data: bytes) -> Counts:
    points = re.search(rb"^\s*POINTS\s+(\d+)", data, re.M | re.I)
    cells = re.search(rb"^\s*CELL_TYPES\s+(\d+)", data, re.M | re.I)
    return Counts(*(int(head.group(1)) if head else None for head in (points, cells)))


def _vtu(data: bytes) -> Counts:
    pieces = re.findall(rb"<Piece\b[^>]*>", data)
    if len(pieces) > 1:
        raise ReadError(f"it has {len(pieces)} pieces, of which meshio keeps the last: write it as one piece")
    heads = (re.search(rb"%s\s*=\s*[\"']\s*(\d+)" % name, b"".join(pieces)) for name in _OF_PIECE)
    return Counts(*(int(head.group(1)) if head else None for head in heads))


_OF_PIECE = (b"NumberOfPoints", b"NumberOfCells")


def _medit(data: bytes) -> Counts:
    if data[:4] in (b"\x01\0\0\0", b"\0\0\0\x01"):  # binary: meshio asks for every number
        return Counts()
    kinds = rb"Edges|Triangles|Quadrilaterals|Tetrahedra|Prisms|Pyramids|Hexahedra|Hexaedra"
    nodes = _only(re.findall(rb"^\s*Vertices\s+(\d+)", data, re.M), "blocks of vertices")
    return Counts(nodes, sum(int(n) for n in re.findall(rb"^\s*(?:%s)\s+(\d+)" % kinds, data, re.M)))


def _only(found: list[Any], what: str) -> int | None:
    if len(found) > 1:
        raise ReadError(f"it has {len(found)} {what}, whose numbers cannot be told apart")
    return int(found[0]) if found else None


_READERS = {"gmsh": _msh, "vtk": _vtk, "vtu": _vtu, "medit": _medit}


def abaqus_text(text: str) -> str:
    """An Abaqus file with all its nodes in the first block: of several, meshio keeps the last.

    Raises:
        ReadError: nodes of several parts with the same numbers, or parts that are placed more than once.
    """
    if len(re.findall(r"^\*instance\b", text, re.M | re.I)) > 1:
        raise ReadError("it places parts (*INSTANCE), which the reader does not: write it flat, without parts")
    blocks = list(_abaqus_blocks(text))
    nodes = [block for block in blocks if re.match(r"\*node\s*(,|$)", block.split("\n", 1)[0], re.I)]
    if len(nodes) < 2:
        return text
    rows = [row for block in nodes for row in block.split("\n")[1:] if row.strip() and not row.startswith("**")]
    numbers = [int(row.split(",", 1)[0]) for row in rows]
    if len(set(numbers)) < len(numbers):
        raise ReadError(
            f"its {len(nodes)} blocks *NODE use the same numbers, so that they cannot be told apart: write it flat, "
            "without parts"
        )
    merged = "\n".join([nodes[0].split("\n", 1)[0], *rows, ""])
    at = blocks.index(nodes[0])
    return "".join([*blocks[:at], merged, *(b for b in blocks[at:] if not any(b is n for n in nodes))])


def _abaqus_blocks(text: str) -> Iterator[str]:
    """A text in parts that begin with a keyword each, whatever comes before the first one apart."""
    return (block for block in re.split(r"^(?=\*[^*])", text, flags=re.M) if block)
