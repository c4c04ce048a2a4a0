"""Warnings that point at the user's line, however many calls of the package lie between."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from pathlib import Path

import torch

# torch's frames are those of its decorators and of its backward, contextlib's those of decorators of ours
_INSIDE = (*(str(Path(module).parent) + os.sep for module in (__file__, torch.__file__)), contextlib.__file__)


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """warnings.warn, for the line outside this package and torch that is being run."""
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_code.co_filename.startswith(_INSIDE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
