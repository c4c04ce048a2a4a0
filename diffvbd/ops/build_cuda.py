"""How the CUDA object is compiled. setup.py reads this file; DIFFVBD_JIT=1 runs a copy of it beside a copy of csrc.

It must not import the package, which does not load before it is built.
"""

from __future__ import annotations

import os
import sys
from glob import glob
from pathlib import Path
from typing import Any

import torch
from torch.utils.cpp_extension import CUDA_HOME, BuildExtension, CUDAExtension

CXX_FLAGS = ["-O3", "-g0", "-fvisibility=hidden", "-Wno-psabi", "-Wno-ignored-attributes"]
# The kernels see no torch header, so their C++ standard is ours to choose.
# Compressed, because there is a kernel for each set of energies: a quarter of the bytes.
NVCC_FLAGS = ["-O3", "-std=c++17", "--expt-relaxed-constexpr", "--extended-lambda", "-Xcompiler", "-fvisibility=hidden"]
NVCC_FLAGS += ["-Xfatbin", "-compress-all"]

# Sources that instantiate templates, one for each variant, so that they compile side by side.
INSTANCES = "build/instances"
TEMPLATES = {  # by header of csrc/cuda, each for both scalars T
    "coarse_gradient": [
        *(f"gradient_kernel_of<T, {wanted}>" for wanted in ("kForward", "kState", "kMaterial", "kAllAdjoints"))
    ],
    "contact": [
        "struct ContactPasses<T>",
        *(f"{name}<T>" for name in ("sum_lag", "pair_lag", "pair_loads", "pair_lag_backward")),
    ],
    "forward": ["forward_kernel<T>"],
    "run": ["workspace_bytes<T>", "run_forward<T>", "run_reverse<T>"],
    "scene_forward": ["run_scene_forward<T>"],
    "scene_reverse": ["run_scene_reverse<T>"],
}
WANTED = {"state": "kState", "material": "kMaterial", "rest": "kAllAdjoints"}
# The transposed sweeps take longest: few threads a vertex and many are compiled apart.
LANES = {"few": ("kFewLanes", "kSomeReverseLanes"), "many": ("kManyLanes", "kSpillLanes")}


def instance(header: str, templates: list[str], scalar: str, csrc: str = "../../csrc") -> str:
    """Source of instances of templates of a header."""
    names = [template.replace("<T", f"<{scalar}") for template in templates]
    lines = [f"template {n};" if n.startswith("struct ") else f"template decltype({n}) {n};" for n in names]
    include = f'#include "{csrc}/cuda/{header}.cuh"'
    return "\n".join([include, "", "namespace diffvbd::cuda {", *lines, "}  // namespace diffvbd::cuda", ""])


def reverse_names(wanted: str, lanes: str) -> list[str]:
    return [f"reverse_kernel<T, ({WANTED[wanted]}), {count}>" for count in LANES[lanes]]


def cuda_instances() -> dict[str, str]:
    """Sources of template instances for the CUDA object: text by name."""
    out = {}
    for scalar in ("double", "float"):
        out |= {f"{header}_{scalar}.cu": instance(header, names, scalar) for header, names in TEMPLATES.items()}
        for wanted in WANTED:
            for share in LANES:
                name = f"reverse_{wanted}_{scalar}_{share}.cu"
                out[name] = instance("reverse", reverse_names(wanted, share), scalar)
    return out


def law_instances(scalar: str, csrc: str) -> dict[str, str]:
    """The same for the object of a generated law: some threads or many a vertex, and all adjoints."""
    gradients = [name for name in TEMPLATES["coarse_gradient"] if "kForward" in name or "kAllAdjoints" in name]
    own = {name: TEMPLATES[name] for name in ("contact", "forward", "run")} | {"coarse_gradient": gradients}
    out = {f"{header}.cu": instance(header, names, scalar, csrc) for header, names in own.items()}
    for share, names in {"some": reverse_names("rest", "few")[1:], "many": reverse_names("rest", "many")}.items():
        out[f"reverse_{share}.cu"] = instance("reverse", names, scalar, csrc)
    return out


def write_instances(sources: dict[str, str]) -> list[str]:
    """Paths of these sources in the current folder. One that has its text already is left alone: no new compilation."""
    paths = []
    for name, text in sources.items():
        path = Path(INSTANCES, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
        paths.append(path.as_posix())
    return paths


def has_compiler() -> bool:
    """A torch with CUDA and an nvcc. Whether there is a device says nothing: wheels are built without one."""
    return bool(torch.version.cuda and CUDA_HOME and os.path.exists(os.path.join(CUDA_HOME, "bin", "nvcc")))


def architectures() -> str:
    """TORCH_CUDA_ARCH_LIST; or what the visible devices are; or, where there is none, what a wheel should run on."""
    listed = os.environ.get("TORCH_CUDA_ARCH_LIST")
    if listed and listed != "native":
        return listed
    if torch.cuda.is_available():
        found = sorted({torch.cuda.get_device_capability(i) for i in range(torch.cuda.device_count())})
        return " ".join(f"{major}.{minor}" for major, minor in found) + "+PTX"
    cuda = tuple(int(part) for part in (torch.version.cuda or "0.0").split(".")[:2])
    return "8.0 9.0 10.0 12.0+PTX" if cuda >= (12, 8) else "8.0 9.0+PTX"


def extension() -> Any:
    """diffvbd._C_cuda of the csrc in the current folder; chooses the architectures for the build of this process."""
    os.environ["TORCH_CUDA_ARCH_LIST"] = architectures()  # without a device torch itself would not know any
    return CUDAExtension(
        "diffvbd._C_cuda",
        [
            *sorted(glob("csrc/bind/*.cpp")),
            *write_instances(cuda_instances()),  # first of the kernels: they take longest
            *sorted(glob("csrc/cuda/*.cu")),
        ],
        define_macros=[("TORCH_TARGET_VERSION", "0x020b000000000000"), ("USE_CUDA", None)],
        extra_compile_args={"cxx": CXX_FLAGS, "nvcc": NVCC_FLAGS},
        extra_link_args=["-s"],
        depends=sorted(path for end in ("h", "cuh") for path in glob(f"csrc/**/*.{end}", recursive=True)),
        py_limited_api=True,
    )


if __name__ == "__main__":
    from setuptools import setup

    if not has_compiler():
        sys.exit(f"no nvcc for CUDA {torch.version.cuda} (CUDA_HOME is {CUDA_HOME}): install one, or set CUDA_HOME")
    setup(
        name="diffvbd",
        ext_modules=[extension()],
        cmdclass={"build_ext": BuildExtension},
        script_args=["build_ext", "--build-lib", "lib", "--build-temp", "temp"],
    )
