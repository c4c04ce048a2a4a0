"""Builds the native objects of diffvbd against the torch that is installed.

Environment:
    DIFFVBD_NO_CLONES=1  compile the CPU kernels for the baseline instruction set only (quicker builds, slower kernels)
"""

import os
import sys
from glob import glob

from setuptools import setup

try:
    from torch.utils.cpp_extension import BuildExtension, CppExtension
except ImportError:
    sys.exit("diffvbd: torch is not importable here.\nInstall torch first, then: pip install --no-build-isolation .")

CPU_SOURCES = [
    "csrc/ops.cpp",
    "csrc/cpu/checks.cpp",
    "csrc/cpu/layout.cpp",
    "csrc/cpu/plan.cpp",
    "csrc/cpu/register.cpp",
    "csrc/cpu/run.cpp",
    "csrc/cpu/sweep_backward_double.cpp",
    "csrc/cpu/sweep_backward_float.cpp",
    "csrc/cpu/sweep_forward.cpp",
]

# -ffp-contract=off: the same bits from every instruction set. -fno-math-errno: sqrt is one instruction.
FLAGS = ["-O3", "-g0", "-fno-math-errno", "-ffp-contract=off", "-Wno-psabi", "-Wno-ignored-attributes"]
if os.environ.get("DIFFVBD_NO_CLONES"):
    FLAGS += ["-DDIFFVBD_NO_CLONES"]

setup(
    ext_modules=[
        CppExtension(
            "diffvbd._C",
            CPU_SOURCES,
            define_macros=[("TORCH_TARGET_VERSION", "0x020b000000000000")],
            extra_compile_args=FLAGS,
            extra_link_args=["-s"],
            depends=sorted(glob("csrc/**/*.h", recursive=True)),
            py_limited_api=True,
        )
    ],
    cmdclass={"build_ext": BuildExtension},
    options={"bdist_wheel": {"py_limited_api": "cp310"}},
)
