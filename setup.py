"""Builds the native objects of diffvbd against the torch that is installed.

Environment:
    DIFFVBD_NO_CLONES=1  compile the CPU kernels for the baseline instruction set only (quicker builds, slower kernels)
    DIFFVBD_QUICK=1      one instruction set, less optimisation, no paper's block and no CUDA: for work on an energy
    DIFFVBD_NO_CUDA=1    leave the CUDA object out; without it, it is built where torch has CUDA and nvcc is found
    TORCH_CUDA_ARCH_LIST what the CUDA object runs on (default: the visible devices, or 8.0 9.0 10.0 12.0+PTX)
    CUDA_HOME, MAX_JOBS  read by torch
    DIFFVBD_LOCAL_VERSION  e.g. cu130: the version of the package becomes X.Y.Z+cu130 (.ci/wheels.py sets it)
"""

import os
import re
import runpy
import shutil
import sys
from glob import glob
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

try:
    from torch.utils.cpp_extension import BuildExtension, CppExtension
except ImportError:
    sys.exit(
        "diffvbd: this build cannot import torch. pip builds in an empty environment, which sees no torch, even if one "
        "is installed.\nInstall torch if it is missing, then: pip install --no-build-isolation ."
    )

# Run, not imported: the package does not load before it is built.
cuda = runpy.run_path("diffvbd/ops/build_cuda.py")
QUICK = bool(os.environ.get("DIFFVBD_QUICK"))
INSTRUCTION_SETS = ["baseline"] if QUICK or os.environ.get("DIFFVBD_NO_CLONES") else ["v4", "v3", "baseline"]


def sweep_instance(scalar: str, name: str) -> str:
    """Source of the sweeps of a scalar for an instruction set."""
    lines = ['#include "../../csrc/cpu/sweep_kernels.h"']
    lines += [f"template diffvbd::Kernels<{scalar}> diffvbd::{name}::sweep_kernels<{scalar}>();"]
    if name != "baseline":
        lines = [
            # The standard library comes first: what it has inline is compiled for every processor.
            '#include "../../csrc/cpu/standard.h"',
            "#ifdef DIFFVBD_HAS_SETS",
            f'#pragma GCC target("arch=x86-64-{name}")',
            f"#define DIFFVBD_SET {name}",
            "#define DIFFVBD_UPPER_HALVES",
            *lines,
            "#endif",
        ]
    return "\n".join([*lines, ""])


SWEEPS = {f"sweep_{s}_{name}.cpp": sweep_instance(s, name) for s in ("double", "float") for name in INSTRUCTION_SETS}
CPU_SOURCES = [
    *cuda["write_instances"](SWEEPS),  # first: they take longest
    *sorted(glob("csrc/bind/*.cpp")),
    *sorted(glob("csrc/cpu/*.cpp")),
]

# -ffp-contract=off: the same bits from every instruction set. -fno-math-errno: sqrt is one instruction.
FLAGS = ["-O3", "-g0", "-fno-math-errno", "-ffp-contract=off", "-Wno-psabi", "-Wno-ignored-attributes"]
FLAGS += ["-Wno-attributes"]  # torch hides its Tensor, so GCC warns of each struct with one
if INSTRUCTION_SETS == ["baseline"]:
    FLAGS += ["-DDIFFVBD_NO_CLONES"]
if QUICK:
    FLAGS += ["-O1", "-DDIFFVBD_QUICK"]


def long_description() -> str:
    """README.md as a package index shows it, where relative links lead nowhere: they become text, and images go."""
    text = Path("README.md").read_text(encoding="utf-8")
    text = re.sub(r"!\[[^\]]*\]\((?![a-z]+:)[^)]*\)\n*", "", text)
    return re.sub(r"\[([^\]]*)\]\((?![a-z]+:)[^)]*\)", r"\1", text)


# csrc: DIFFVBD_JIT=1 compiles it. docs: messages and docstrings name these pages.
PACKED = [p for where in ("csrc/**/*", "docs/*.md") for p in glob(where, recursive=True) if os.path.isfile(p)]


class BuildPy(build_py):
    """Ships csrc and the pages of docs, as text without pictures, inside the package and in the sdist."""

    def run(self):
        super().run()
        if self.editable_mode:
            return
        package = Path(self.build_lib, "diffvbd")
        for folder in ("csrc", "docs"):
            shutil.rmtree(package / folder, ignore_errors=True)  # of an earlier build, with files that are gone since
        for path in PACKED:
            (package / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, package / path)

    def get_source_files(self):
        return super().get_source_files() + PACKED


class BuildExt(BuildExtension):
    """Keeps the objects of each extension apart: both compile csrc/bind."""

    def build_extension(self, ext):
        temp, self.build_temp = self.build_temp, os.path.join(self.build_temp, ext.name)
        super().build_extension(ext)
        self.build_temp = temp


extensions = [
    CppExtension(
        "diffvbd._C",
        CPU_SOURCES,
        define_macros=[("TORCH_TARGET_VERSION", "0x020b000000000000")],
        extra_compile_args=FLAGS,
        extra_link_args=["-s"],
        depends=sorted(glob("csrc/**/*.h", recursive=True)),
        py_limited_api=True,
    )
]
if cuda["has_compiler"]() and not os.environ.get("DIFFVBD_NO_CUDA") and not QUICK:
    extensions.append(cuda["extension"]())

# Wheels with and without CUDA stand side by side, so their names must differ.
local_version = os.environ.get("DIFFVBD_LOCAL_VERSION")

setup(
    long_description=long_description(),
    long_description_content_type="text/markdown",
    ext_modules=extensions,
    cmdclass={"build_ext": BuildExt, "build_py": BuildPy},
    options={
        "bdist_wheel": {"py_limited_api": "cp310"},
        "egg_info": {"tag_build": f"+{local_version}" if local_version else ""},
    },
)
