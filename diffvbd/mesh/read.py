"""Reading of mesh files, by the reader that knows them: meshio, trimesh for surfaces, our own for TetGen.

No reader tells what it has left out, and some never end on a truncated file. Counts in headers are therefore compared
with what arrives, and text is read through a file that ends once. Volume cells are cut into tets, faces into triangles.
"""

from __future__ import annotations

import io
import re
import struct
import tempfile
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import meshio
import numpy as np
from meshio import ReadError
from numpy.typing import NDArray

from diffvbd.mesh.arrays import IntArray
from diffvbd.mesh.write import PREFERRED_FORMAT, quiet

SURFACES = (".obj", ".off", ".ply", ".stl")  # of these meshio loses or refuses too much; they hold no tets
# What meshio reads from an open file; some of these readers wait for a word that a truncated file does not have.
_TEXT = ("abaqus", "avsucd", "medit", "nastran", "netgen", "permas", "su2", "tecplot")


# VTK's numbers of cells, as meshio names them: those whose corners come first.
_VTK = {5: "triangle", 9: "quad", 22: "triangle6", 10: "tetra", 24: "tetra10", 12: "hexahedron", 25: "hexahedron20",
        13: "wedge", 26: "wedge15", 14: "pyramid", 27: "pyramid13"}  # fmt: skip


def read_cells(source: Any) -> tuple[meshio.Mesh, list[str]]:
    """Cells of a mesh file, or of a mesh of meshio, pyvista or trimesh, and notes on what was not read.

    Raises:
        TypeError: neither a path nor such a mesh.
        FileNotFoundError: no such file.
        ValueError: no reader knows it, it ends too early, or what arrived is not what its header names.
        ImportError: the format needs a package that is not installed.
    """
    if not isinstance(source, (str, PathLike)):
        return _cells_of_object(source)
    path = Path(source)
    if path.suffix.lower() in SURFACES:
        return _read_surface(path), []
    _check_is_file(path)
    warned: list[str] = []
    content, notes = quiet(lambda: _read_cells(path), f"read {path}", warned)
    return content, notes + warned


def _cells_of_object(mesh: Any) -> tuple[meshio.Mesh, list[str]]:
    """Cells of an object, known by its attributes, so that no library need be imported."""
    if isinstance(mesh, meshio.Mesh):
        return mesh, []
    if hasattr(mesh, "geometry") and hasattr(mesh, "to_mesh"):  # trimesh.Scene
        mesh = mesh.to_mesh()
    if hasattr(mesh, "vertices") and hasattr(mesh, "faces"):  # trimesh.Trimesh
        return meshio.Mesh(np.asarray(mesh.vertices), [("triangle", np.asarray(mesh.faces))]), []
    if hasattr(mesh, "points") and hasattr(mesh, "n_strips"):  # pyvista.PolyData
        return meshio.Mesh(np.asarray(mesh.points), [("triangle", mesh.triangulate().regular_faces)]), []
    if not hasattr(mesh, "celltypes") or not hasattr(mesh, "cells_dict"):  # pyvista.UnstructuredGrid
        got = type(mesh).__name__
        raise TypeError(f"source: expected a path, or a mesh of trimesh, pyvista or meshio, got {got}")
    kinds, blocks = np.asarray(mesh.celltypes), mesh.cells_dict
    known = [kind for kind in blocks if kind in _VTK]
    cell_data: dict[str, Any] = {
        name: [np.asarray(rows)[kinds == kind] for kind in known] for name, rows in mesh.cell_data.items()
    }
    left_out = int((~np.isin(kinds, known)).sum())
    content = meshio.Mesh(np.asarray(mesh.points), [(_VTK[kind], blocks[kind]) for kind in known],
                          dict(mesh.point_data.items()), cell_data)  # fmt: skip
    return content, [f"{left_out} of its cells are of kinds that are not known here"] if left_out else []


def _read_surface(path: Path) -> meshio.Mesh:
    """Triangles of one of SURFACES; faces of more corners are cut."""
    _check_is_file(path)
    try:
        import trimesh
    except ImportError:
        raise ImportError(f"reading {path.suffix} needs trimesh: pip install 'diffvbd[mesh]'") from None

    def action() -> meshio.Mesh:
        named = faces_named(path)
        data, kind = path.read_bytes(), path.suffix.lower()[1:]
        if kind == "obj":  # trimesh makes vertices for each material, texture coordinate and normal
            lines = re.findall(rb"^[ \t]*[vf][ \t].*$", re.sub(rb"\\\r?\n", b" ", data), re.M)
            data = re.sub(rb"(?<=\d)/\S*", b"", b"\n".join(lines))
        found = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False)
        triangles = np.asarray(found.faces, dtype=np.int64).reshape(-1, 3)
        if named is not None and len(triangles) < named:
            got = f"it has {named} faces, and the reader found {len(triangles)}"
            raise ReadError(f"{got}: truncated, or not written as usual")
        return meshio.Mesh(np.asarray(found.vertices), [("triangle", triangles)])

    return quiet(action, f"read {path}")


def _check_is_file(path: Path) -> None:
    if not path.is_file():
        raise FileNotFoundError(f"mesh file {path} {'is not a file' if path.exists() else 'does not exist'}")


def _read_cells(path: Path) -> tuple[meshio.Mesh, list[str]]:
    kind = _kind(path)
    if kind == "tetgen":
        return read_tetgen(path), []
    named = counts_named(path, kind)
    content, notes = _read_msh(path) if kind == "gmsh" else (_read_as(kind, path), [])
    nodes, cells = len(content.points), sum(len(block.data) for block in content.cells)
    if named.nodes is not None and nodes != named.nodes:
        raise ReadError(f"it names {named.nodes} nodes, and the reader found {nodes}")
    if named.cells is not None and cells < named.cells:
        notes.append(f"{named.cells - cells} of its {named.cells} cells are of kinds that the reader does not know")
    return content, notes


def _kind(path: Path) -> str:
    """Name of the format in meshio."""
    suffix = path.suffix.lower()
    if suffix == ".vtk":
        with path.open("rb") as file:
            return "vtu" if file.read(64).lstrip()[:1] == b"<" else "vtk"  # SOFA names .vtu so
    if suffix in PREFERRED_FORMAT:
        return PREFERRED_FORMAT[suffix]
    known = meshio.extension_to_filetypes.get("".join(path.suffixes[-2:]).lower())
    known = known or meshio.extension_to_filetypes.get(suffix)
    if not known:
        raise ReadError(f"no reader knows files that end in {suffix or 'nothing'}")
    return known[0]


def _read_as(kind: str, path: Path) -> meshio.Mesh:
    if kind == "abaqus":
        text = path.read_text(encoding="utf-8", errors="replace")
        merged = abaqus_text(text)
        if merged is not text:
            return meshio.read(io.StringIO(merged), kind)
    if kind in _TEXT and path.suffix.lower() not in (".gz", ".meshb"):
        with _Text(path.open("rb"), encoding="utf-8", errors="replace") as file:
            return meshio.read(file, kind)
    if kind == "mdpa":
        with _Bytes(path.open("rb", buffering=0)) as file:
            return meshio.read(file, kind)
    return meshio.read(path, kind)


def _read_msh(path: Path) -> tuple[meshio.Mesh, list[str]]:
    """A Gmsh file. meshio fails where only some volumes have groups, on partitions, and on the versions 1 and 4.0; what
    it fails on is read again without all but nodes and elements, in words that it knows."""
    data = path.read_bytes()
    version = msh_version(data)
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


class Counts(NamedTuple):
    """Numbers of nodes and cells in the header of a file; None where it does not say."""

    nodes: int | None = None
    cells: int | None = None


def counts_named(path: Path, kind: str) -> Counts:
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


def faces_named(path: Path) -> int | None:
    """Number of faces that a surface file names, or has lines for."""
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
        lines = data[start : data.find(b"$EndNodes", start)].split(b"\n")[1:]
        numbers = np.array([line.split(None, 1)[0] for line in lines if line.strip()])
        if len(np.unique(numbers)) < len(numbers):
            raise ReadError("some of its nodes have the same number, so that they cannot be told apart")
    return Counts(*(head[0] if head else None for head in found))


def _vtk(data: bytes) -> Counts:
    return _counts(data, rb"(?i)^\s*POINTS\s+(\d+)", rb"(?i)^\s*CELL_TYPES\s+(\d+)")


def _counts(data: bytes, *patterns: bytes) -> Counts:
    heads = (re.search(pattern, data, re.M) for pattern in patterns)
    return Counts(*(int(head.group(1)) if head else None for head in heads))


def _vtu(data: bytes) -> Counts:
    pieces = re.findall(rb"<Piece\b[^>]*>", data)
    if len(pieces) > 1:
        raise ReadError(f"it has {len(pieces)} pieces, of which meshio keeps the last: write it as one piece")
    names = (b"NumberOfPoints", b"NumberOfCells")
    return _counts(b"".join(pieces), *(rb"%s\s*=\s*[\"']\s*(\d+)" % name for name in names))


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
    # parts that begin with a keyword each, whatever comes before the first one apart
    blocks = [block for block in re.split(r"^(?=\*[^*])", text, flags=re.M) if block]
    nodes = [block for block in blocks if re.match(r"\*node\s*(,|$)", block.split("\n", 1)[0], re.I)]
    if len(nodes) < 2:
        return text
    rows = [row for block in nodes for row in block.split("\n")[1:] if row.strip() and not row.startswith("**")]
    numbers = [int(row.split(",", 1)[0]) for row in rows]
    if len(set(numbers)) < len(numbers):
        shared = f"its {len(nodes)} blocks *NODE use the same numbers, so that they cannot be told apart"
        raise ReadError(f"{shared}: write it flat, without parts")
    merged = "\n".join([nodes[0].split("\n", 1)[0], *rows, ""])
    at = blocks.index(nodes[0])
    return "".join([*blocks[:at], merged, *(b for b in blocks[at:] if not any(b is n for n in nodes))])


def read_tetgen(path: Path) -> meshio.Mesh:
    """The two files of one name. Names of values are those that meshio gives them."""
    (_, dimension, *more), nodes = _table(path.with_suffix(".node"))
    if dimension != 3:
        raise ReadError(f"expected nodes in 3 dimensions, got {dimension}")
    (_, corners, *_), cells = _table(path.with_suffix(".ele"))
    if corners not in (4, 10) or nodes.shape[1] < 4 or cells.shape[1] < 1 + corners:
        got = f"{corners} nodes a tet, rows of {nodes.shape[1]} and {cells.shape[1]} numbers"
        raise ReadError(f"expected 4 or 10 nodes a tet, and rows with all of their numbers, got {got}")
    first = int(nodes[0, 0]) if len(nodes) else 0
    if not np.array_equal(nodes[:, 0], np.arange(first, first + len(nodes))):
        raise ReadError("expected nodes that are numbered one after another")
    attributes = more[0] if more else 0
    values = {f"tetgen:attr{k + 1}": nodes[:, 4 + k] for k in range(attributes)}
    values |= _marks(nodes[:, 4 + attributes :])
    block = (("tetra", "tetra10")[corners == 10], cells[:, 1 : 1 + corners].astype(np.int64) - first)
    marks: dict[str, Any] = {name: [column] for name, column in _marks(cells[:, 1 + corners :]).items()}
    return meshio.Mesh(nodes[:, 1:4], [block], point_data=dict(values), cell_data=marks)


def _marks(columns: NDArray[Any]) -> dict[str, NDArray[Any]]:
    names = ("tetgen:ref", *(f"tetgen:ref{k}" for k in range(2, columns.shape[1] + 1)))
    whole = columns.astype(np.int64)
    columns = whole if np.array_equal(whole, columns) else columns
    return dict(zip(names, columns.T, strict=False))


def _table(path: Path) -> tuple[list[int], NDArray[Any]]:
    """The numbers in the first line of a file, the first of which counts the rows that follow, and these."""
    lines = (line.partition("#")[0].split() for line in path.read_text(errors="replace").splitlines())
    lines = [line for line in lines if line]
    if not lines:
        raise ReadError(f"{path.name} is empty")
    head = [int(word) for word in lines[0]]
    rows = lines[1 : 1 + head[0]]
    if len(rows) < head[0]:
        raise ReadError(f"truncated: {path.name} names {head[0]} rows and has {len(rows)}")
    return head, np.array(rows, dtype=np.float64).reshape(len(rows), -1)


# Faces of a cell's corners, wound so that their normals point out of it, in the order of meshio.
_FACES = {
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
_CORNERS = {"tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5, "triangle": 3, "quad": 4}
_LAGRANGE = {
    f"VTK_LAGRANGE_{name}": kind
    for name, kind in {"TETRAHEDRON": "tetra", "TRIANGLE": "triangle", "QUADRILATERAL": "quad"}.items()
} | {f"VTK_LAGRANGE_{name.upper()}": name for name in _FACES}


class Tets(NamedTuple):
    """Tets [T, 4] of the points of a file; for each block of cells that they come from, its index and the row in it of
    each tet; and how many cells of which kinds were cut into tets, lost the nodes between their corners, and were left
    out."""

    tets: IntArray
    rows: list[tuple[int, IntArray]]
    cut: dict[str, int]
    curved: dict[str, int]
    left_out: dict[str, int]


def kind_of(cells: Any) -> str:
    """'hexahedron' for hexahedron20 and all others of more nodes: the corners come first in each of them."""
    return _LAGRANGE.get(cells.type) or str(cells.type).rstrip("0123456789")


def tets_of(content: meshio.Mesh) -> Tets:
    """Tets of all volume cells, in the order of the file, and what became of the cells."""
    found, rows, cut, curved, left_out = [], [], {}, {}, {}
    for k, cells in enumerate(content.cells):
        kind, number = kind_of(cells), len(cells.data)
        if kind == "tetra":
            tets, parents = cells.data[:, :4].astype(np.int64), np.arange(number)
        elif kind in _FACES:
            tets, parents = _cut(cells.data[:, : _CORNERS[kind]].astype(np.int64), _FACES[kind])
            cut[kind] = cut.get(kind, 0) + number
        else:
            if cells.dim == 3 and number:
                left_out[kind] = left_out.get(kind, 0) + number
            continue
        if cells.data.shape[1] > _CORNERS[kind] and number:
            curved[kind] = curved.get(kind, 0) + number
        found.append(tets)
        rows.append((k, parents))
    return Tets(np.concatenate(found) if found else np.empty((0, 4), dtype=np.int64), rows, cut, curved, left_out)


def _cut(cells: IntArray, faces: tuple[tuple[int, ...], ...]) -> tuple[IntArray, IntArray]:
    """Tets [T, 4] from the lowest vertex of each cell to the faces that do not have it, and the cell of each tet.

    A quad is cut from its own lowest vertex, so that both of its cells cut it alike (Dompierre et al., "How to
    subdivide pyramids, prisms, and hexahedra into tetrahedra", 8th International Meshing Roundtable, 1999).
    """
    lowest = cells.min(axis=1)
    tets, parents = [], []
    for face in faces:
        corners = cells[:, face]
        first = corners.argmin(axis=1)
        turned = np.take_along_axis(corners, (first[:, None] + np.arange(len(face))) % len(face), axis=1)
        away = np.flatnonzero(turned[:, 0] != lowest)
        for k in range(1, len(face) - 1):
            tets.append(np.column_stack([lowest[away], turned[away][:, [0, k, k + 1]]]))
            parents.append(away)
    tets, parents = np.concatenate(tets), np.concatenate(parents)
    order = np.argsort(parents, kind="stable")
    tets, parents = tets[order], parents[order]
    # some mesh wedges and pyramids as hexahedra that name a vertex twice
    ranked = np.sort(tets, axis=1)
    whole = (ranked[:, 1:] != ranked[:, :-1]).all(axis=1)
    return tets[whole], parents[whole]


def triangles_of(content: meshio.Mesh) -> IntArray:
    """Triangles [F, 3] of all faces: those of more corners are cut from their first corner."""
    found = [np.empty((0, 3), dtype=np.int64)]
    for cells in content.cells:
        kind = kind_of(cells)
        if kind in ("triangle", "quad", "polygon") and len(cells.data):
            corners = np.asarray(cells.data)[:, : _CORNERS.get(kind)].astype(np.int64)
            fan = [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
            found.append(np.stack(fan, axis=1).reshape(-1, 3))
    return np.concatenate(found)


def listed_kinds(kinds: dict[str, int]) -> str:
    """'2 hexahedron, 1 wedge'."""
    return ", ".join(f"{number} {kind}" for kind, number in kinds.items())
