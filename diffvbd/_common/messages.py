"""Messages: warnings that point at the user's line and at pages to read, and the log."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import traceback
import warnings
from pathlib import Path

import torch

_PACKAGE = Path(__file__).parents[1]
# torch's frames are those of its decorators and of its backward, contextlib's those of decorators of ours
_INSIDE = (*(str(folder) + os.sep for folder in (_PACKAGE, Path(torch.__file__).parent)), contextlib.__file__)

# Inside an installed package, beside the package in a checkout.
PAGES = next((path for path in (_PACKAGE / "docs", _PACKAGE.parent / "docs") if path.is_dir()), _PACKAGE / "docs")


LOGGER = logging.getLogger("diffvbd")


def log_progress(message: str, *values: object) -> None:
    """A line of the log, printed to stderr where the program has not set up logging."""
    if not LOGGER.hasHandlers():
        LOGGER.addHandler(logging.StreamHandler())
        LOGGER.setLevel(logging.INFO)
    LOGGER.info(message, *values)


def page(name: str) -> str:
    """The end of a message: which page of the documentation says more, and where this installation has it."""
    return f"see {PAGES / name}"


def percent(share: float) -> str:
    """A share [-] with two digits, as "0.52 %", "17 %" or "220 %"."""
    return f"{100 * share:.2g} %" if 100 * share < 99.5 else f"{100 * share:.0f} %"


def is_own(error: BaseException) -> bool:
    """Whether an error, from where it was caught on, has come through this package and torch alone: through no
    function of a user."""
    return all(frame.f_code.co_filename.startswith(_INSIDE) for frame, _ in traceback.walk_tb(error.__traceback__))


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """warnings.warn, for the line outside this package and torch that is being run."""
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_code.co_filename.startswith(_INSIDE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
