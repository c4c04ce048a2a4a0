"""Arrays that users give: copies in one dtype, of a checked shape, finite."""

from __future__ import annotations

import os
import sys
import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST = 10**6  # vertices in a row
_PACKAGE = str(Path(__file__).parents[1]) + os.sep


def warn(message: str) -> None:
    """warnings.warn for the line outside this package that is being run; `said.warn` without torch."""
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)


def check_mesh(mesh: Any) -> None:
    """Raises unless `mesh` looks like a TetMesh. Not by isinstance: tet_mesh.py imports write.py, which calls this."""
    if not all(hasattr(mesh, name) for name in ("points", "tets", "body")):
        raise TypeError(f"mesh: expected a diffvbd.TetMesh, got {type(mesh).__name__}")


def check_flag(name: str, value: Any) -> None:
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name}: expected a bool, got {type(value).__name__}")


def to_path(name: str, path: Any) -> Path:
    """A file that a user names."""
    if not isinstance(path, (str, PathLike)):
        raise TypeError(f"{name}: expected a path, got {type(path).__name__}")
    return Path(path)


def to_numpy(name: str, array: Any) -> NDArray[Any]:
    """`array` as a numpy array; torch tensors are detached and brought to the CPU first (torch is not imported)."""
    try:
        return np.asarray(array.detach().cpu() if hasattr(array, "detach") else array)
    except (TypeError, RuntimeError):  # of sparse tensors and those of the meta device
        raise TypeError(f"{name}: expected numbers in a dense array, got {type(array).__name__}") from None
    except ValueError as failure:
        if "inhomogeneous" not in str(failure):
            raise
        raise ValueError(f"{name}: expected an array, or lists of equal lengths, got lists of several") from None


def float_array(name: str, array: Any, shape: tuple[int | None, ...]) -> FloatArray:
    """A finite float64 copy of `array`; None in `shape` stands for any length."""
    if getattr(array, "requires_grad", False):
        raise TypeError(
            f"{name}: expected numbers, got a tensor that requires grad, which a copy would not pass on: detach it, "
            "and give what is differentiated, as rest_points or colliders, to a step or a rollout"
        )
    values = to_numpy(name, array)
    if values.size and values.dtype.kind not in "fiu":
        raise TypeError(f"{name}: expected real numbers, got dtype {values.dtype}")
    _check_shape(name, values, shape)
    values = np.array(values, dtype=np.float64, order="C")
    if not np.isfinite(values).all():
        if values.ndim == 0:
            raise ValueError(f"{name}: expected a finite number, got {values}")
        bad = np.unique(np.nonzero(~np.isfinite(values))[0])
        raise ValueError(f"{name}: expected finite numbers, got NaN or Inf in {listed(bad, 'row')}")
    return values


def int_array(name: str, array: Any, shape: tuple[int | None, ...]) -> IntArray:
    """An int64 copy of `array`; floats are refused, even whole ones."""
    values = to_numpy(name, array)
    if values.size and values.dtype.kind not in "iu":
        raise TypeError(f"{name}: expected integers, got dtype {values.dtype}")
    _check_shape(name, values, shape)
    return np.array(values, dtype=np.int64, order="C")


def _check_shape(name: str, values: NDArray[Any], shape: tuple[int | None, ...]) -> None:
    fits = values.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, values.shape, strict=True))
    if not fits:
        wanted = ", ".join("*" if n is None else str(n) for n in shape)
        raise ValueError(f"{name}: expected shape [{wanted}], got {list(values.shape)}")


def listed(ids: IntArray, noun: str) -> str:
    """'3 tets: 1, 5, 9', at most five of them."""
    shown = ", ".join(map(str, ids[:5])) + (", ..." if len(ids) > 5 else "")
    return f"{len(ids)} {noun}{'' if len(ids) == 1 else 's'}: {shown}"


def count(name: str, value: Any, least: int, noun: str = "") -> int:
    """`value` as an int of at least `least`; ``noun`` says of what."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name}: expected an integer, got {value!r}")
    if not least <= value <= MOST:
        bound = f"at least {least}" if value < least else f"at most {MOST}"
        raise ValueError(f"{name}: expected {bound}{noun and ' '}{noun}, got {value}")
    return int(value)


def positive(name: str, value: Any) -> float:
    """`value` as a positive, finite float."""
    number = float(float_array(name, value, ()))
    if number <= 0:
        raise ValueError(f"{name}: expected a positive length, got {number:.6g}")
    return number


def connected(cells: IntArray, count: int) -> IntArray:
    """The lowest vertex of the connected cells [C, N] that each of `count` vertices is in, shape [count]."""
    label = np.arange(count)
    while True:  # each vertex takes the lowest label of its cells, and that label's own: paths halve each time
        lowest = label[cells].min(axis=1)
        new = label.copy()
        for corner in cells.T:
            np.minimum.at(new, corner, lowest)
        new = new[new]
        if np.array_equal(new, label):
            return label
        label = new
