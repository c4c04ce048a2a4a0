"""A C++ compiler for tests of the headers alone."""

import os
import shutil

import pytest


def cxx() -> list[str]:
    """The command that compiles; skips the test where there is none."""
    found = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if found is None:
        pytest.skip("no C++ compiler: set CXX, or install g++ or clang++")
    return found.split()
