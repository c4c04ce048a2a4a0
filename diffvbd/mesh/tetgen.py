"""TetGen's .node and .ele, which meshio reads neither with attributes that are real numbers nor with ten-node tets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray


def read_tetgen(path: Path) -> meshio.Mesh:
    """The two files of one name. Names of values are those that meshio gives them."""
    (_, dimension, *more), nodes = _table(path.with_suffix(".node"))
    if dimension != 3:
        raise meshio.ReadError(f"expected nodes in 3 dimensions, got {dimension}")
    (_, corners, *_), cells = _table(path.with_suffix(".ele"))
    if corners not in (4, 10) or nodes.shape[1] < 4 or cells.shape[1] < 1 + corners:
        got = f"{corners} nodes a tet, rows of {nodes.shape[1]} and {cells.shape[1]} numbers"
        raise meshio.ReadError(f"expected 4 or 10 nodes a tet, and rows with all of their numbers, got {got}")
    first = int(nodes[0, 0]) if len(nodes) else 0
    if not np.array_equal(nodes[:, 0], np.arange(first, first + len(nodes))):
        raise meshio.ReadError("expected nodes that are numbered one after another")
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
        raise meshio.ReadError(f"{path.name} is empty")
    head = [int(word) for word in lines[0]]
    rows = lines[1 : 1 + head[0]]
    if len(rows) < head[0]:
        raise meshio.ReadError(f"truncated: {path.name} names {head[0]} rows and has {len(rows)}")
    return head, np.array(rows, dtype=np.float64).reshape(len(rows), -1)
