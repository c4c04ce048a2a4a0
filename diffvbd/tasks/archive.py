"""Reading .npz files that others wrote: small ones, whatever they claim."""

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

MOST_BYTES = 4 << 30  # of all arrays together, unpacked: 1000 frames of 150,000 vertices
_DAMAGED = (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError, AttributeError, TypeError, KeyError,
            MemoryError, RuntimeError, OverflowError)  # fmt: skip


def read(path: str | Path, expected: str) -> dict[str, Any]:
    """All arrays of an .npz file.

    Raises:
        OSError: the file cannot be opened.
        ValueError: not an .npz file, damaged, or more than MOST_BYTES when unpacked, looked at before it is.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MOST_BYTES:
            raise ValueError(f"{path}: expected at most {MOST_BYTES} bytes of arrays, got {size} when unpacked")
        with np.load(path, allow_pickle=False) as content:
            return dict(content)
    except _DAMAGED:
        raise ValueError(f"{path}: expected {expected}") from None
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: expected {expected}") from None
