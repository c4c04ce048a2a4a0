"""CUDA sources compile for every architecture without a device; the object is found, or compiled once and cached."""

import functools
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.paths import CSRC, ROOT, needs_csrc
from torch.utils import cpp_extension

from diffvbd.ops import build_cuda
from diffvbd.ops import load as native

KERNELS = sorted(CSRC.glob("cuda/*.cu"))
INSTANCES = build_cuda.cuda_instances()
BINDINGS = sorted(CSRC.glob("bind/*.cpp"))
ARCHITECTURES = ("80", "90", "100", "120")
LIMIT = 120  # [s] for what takes one on an idle machine: a hang, not slowness
BUILT = "lib/diffvbd/_C_cuda.abi3.so"  # where setuptools leaves the object


@functools.cache
def nvcc() -> str | None:
    beside = Path(os.environ.get("CUDA_HOME") or cpp_extension.CUDA_HOME or "", "bin", "nvcc")
    return str(beside) if beside.exists() else shutil.which("nvcc")


needs_nvcc = pytest.mark.skipif(nvcc() is None, reason="no nvcc in CUDA_HOME or PATH")


@functools.cache
def quick() -> list[str]:
    """What makes nvcc optimise little: a fifth of the time, and still machine code of everything. None before 12.9."""
    known = subprocess.run([str(nvcc()), "--help"], capture_output=True, text=True).stdout
    return ["--Ofast-compile=max"] if "--Ofast-compile" in known else []


def failures(jobs: list[tuple[Path, list[str]]], folder: Path) -> dict[str, str]:
    """Runs nvcc on each source with its arguments; two at a time, because each takes up to a gigabyte."""

    def run(job: tuple[Path, list[str]]) -> tuple[str, str]:
        source, arguments = job
        name = " ".join([source.name, *(a for a in arguments if a.startswith("-arch"))])
        to = folder / f"{name.replace(' ', '')}.o"
        done = subprocess.run(
            [str(nvcc()), *arguments, "-c", str(source), "-o", str(to)], capture_output=True, text=True
        )
        return name, "" if done.returncode == 0 and to.exists() else done.stderr + done.stdout

    with ThreadPoolExecutor(2) as pool:
        return {name: output for name, output in pool.map(run, jobs) if output}


def compile_for(kernels: list[Path], architectures: list[str], folder: Path, *flags: str) -> None:
    """As the package is built, and with `flags`. Instances are written into the folder."""
    for name, text in INSTANCES.items():
        (folder / name).write_text(text.replace("../../csrc", str(CSRC)), encoding="utf-8")
    kernels = [folder / k if k.name in INSTANCES else k for k in kernels]
    known = subprocess.run([str(nvcc()), "--list-gpu-code"], capture_output=True, text=True).stdout.split()
    missing = {f"sm_{a}" for a in architectures} - set(known)
    if missing:
        pytest.skip(f"this nvcc is too old for {', '.join(sorted(missing))}")
    given = [*build_cuda.NVCC_FLAGS, "-Xcompiler", "-fPIC", *flags]
    failed = failures([(k, [*given, f"-arch=sm_{a}"]) for k, a in zip(kernels, architectures, strict=True)], folder)
    assert not failed, "\n".join(f"{name}:\n{output}" for name, output in failed.items())


# --- the sources ------------------------------------------------------------------------------------------------------


def test_architectures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.6;9.0a")
    assert build_cuda.architectures() == "8.6;9.0a"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda i: [(9, 0), (8, 0), (9, 0)][i])
    for unset in ("", "native"):
        monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", unset)
        assert build_cuda.architectures() == "8.0 9.0+PTX"
    monkeypatch.delenv("TORCH_CUDA_ARCH_LIST")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert build_cuda.architectures() == "8.0 9.0 10.0 12.0+PTX"
    monkeypatch.setattr(torch.version, "cuda", "12.6")  # its nvcc knows no Blackwell
    assert build_cuda.architectures() == "8.0 9.0+PTX"


UNITS = [*KERNELS, *map(Path, INSTANCES)]
TURNS = [(k, ARCHITECTURES[i % len(ARCHITECTURES)]) for i, k in enumerate(UNITS)]
STEMS = [k.stem for k in UNITS]
QUICK = ("contact_float",)  # pairs; the slow ones have the sweep and all energies with their adjoints
HOURS = ("reverse_state", "reverse_material")  # instances of what reverse_rest has, with fewer gradients


def marked(kernel: Path, architecture: str) -> Any:
    if kernel.stem in QUICK:
        return kernel, architecture
    mark = pytest.mark.hours if kernel.stem.startswith(HOURS) else pytest.mark.slow
    return pytest.param(kernel, architecture, marks=mark)


@needs_csrc
@needs_nvcc
@pytest.mark.parametrize(("kernel", "architecture"), [marked(*turn) for turn in TURNS], ids=STEMS)
def test_kernels_compile(tmp_path: Path, kernel: Path, architecture: str) -> None:
    """To machine code, as ptxas alone finds what does not fit the hardware: the variant that has everything. The
    architectures take turns."""
    compile_for([kernel], [architecture], tmp_path, *quick(), "-DDIFFVBD_ONE_VARIANT")


@pytest.mark.hours
@needs_csrc
@needs_nvcc
def test_every_variant_compiles_as_it_is_built(tmp_path: Path) -> None:
    compile_for([k for k in UNITS for _ in ARCHITECTURES], [*ARCHITECTURES] * len(UNITS), tmp_path)


@pytest.mark.slow
@needs_csrc
@needs_nvcc
def test_the_binding_compiles(tmp_path: Path) -> None:
    """Against the torch that is here: the headers of its stable interface do not depend on CUDA."""
    include = [argument for path in cpp_extension.include_paths() for argument in ("-isystem", path)]
    macros = ["-DUSE_CUDA", "-DTORCH_TARGET_VERSION=0x020b000000000000"]
    failed = failures([(path, ["-std=c++20", "-O0", *macros, *include]) for path in BINDINGS], tmp_path)
    assert not failed, failed


# --- without an object ------------------------------------------------------------------------------------------------


@pytest.fixture
def no_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """A torch with CUDA, as far as the loader sees, and no CUDA object."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(native, "_cuda", False)
    monkeypatch.setattr(native, "_why_not", "")
    monkeypatch.delenv("DIFFVBD_JIT", raising=False)


def message() -> str:
    with pytest.raises(RuntimeError) as caught:
        native.require_cuda()
    return str(caught.value)


@pytest.mark.usefixtures("no_object")
def test_the_error_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in (message(), (monkeypatch.setenv("DIFFVBD_JIT", "0"), message())[1]):
        assert "pip install --no-build-isolation" in text and "DIFFVBD_JIT=1" in text and "\n" not in text
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setenv("DIFFVBD_JIT", "1")  # no compiler helps a torch without CUDA
    text = message()
    assert "pip install --no-build-isolation" in text and torch.__version__ in text and "\n" not in text
    assert not native.has_cuda()


@pytest.mark.usefixtures("no_object")
def test_an_object_that_does_not_load_is_reported_when_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken, find = tmp_path / "_C_cuda.abi3.so", native._built
    broken.write_bytes(b"for another CUDA")
    monkeypatch.setattr(native, "_built", lambda name: broken if name == "_C_cuda" else find(name))
    native.load()
    assert not native.has_cuda()
    text = message()
    assert "does not load" in text and broken.name in text and "pip install" in text and "\n" not in text


# --- DIFFVBD_JIT=1 ----------------------------------------------------------------------------------------------------

# Stands for the compiler: leaves a trace of each run and its number as the object; what it does besides, `mode` tells.
FAKE = f"""
import os, pathlib, sys, time
here = pathlib.Path(os.environ["FAKE"])
assert pathlib.Path("csrc/bind/operator.h").exists()
with open(here / "runs", "a") as runs:
    print(os.getpid(), file=runs)
mode = (here / "mode").read_text()
built = pathlib.Path("{BUILT}")
built.parent.mkdir(parents=True)
built.write_text("half")
if mode == "hang":
    (here / "hanging").touch()
    time.sleep(600)
if mode == "fail":
    sys.exit("step.h(7): error: no such thing")
time.sleep(0.2)
built.write_text(f"object {{len((here / 'runs').read_text().split())}}")
"""


class Fake:
    """A package of its own, with sources and the fake compiler."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.package, self.cache = folder, folder / "package", folder / "cache"
        (self.package / "csrc" / "cuda").mkdir(parents=True)
        for path, text in ((("csrc", "bind", "operator.h"), "// nothing"), (("ops", "build_cuda.py"), FAKE)):
            self.package.joinpath(*path).parent.mkdir()
            self.package.joinpath(*path).write_text(text)
        self.mode("build")

    def mode(self, name: str) -> None:
        (self.folder / "mode").write_text(name)

    def runs(self) -> list[int]:
        path = self.folder / "runs"
        return [int(pid) for pid in path.read_text().split()] if path.exists() else []


@pytest.fixture
def fake(tmp_path: Path, no_object: None, monkeypatch: pytest.MonkeyPatch) -> Fake:
    fake = Fake(tmp_path)
    monkeypatch.setattr(native, "_FOLDER", fake.package)
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(fake.cache))
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "9.0")
    monkeypatch.setenv("FAKE", str(tmp_path))
    monkeypatch.setenv("DIFFVBD_JIT", "1")
    return fake


def test_jit_compiles_once_for_what_it_depends_on(fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    with ThreadPoolExecutor(4) as pool:  # whoever comes second waits
        paths = {future.result() for future in [pool.submit(native.jit_build) for _ in range(4)]}
    (first,) = paths
    assert first.read_text() == "object 1" and fake.cache in first.parents
    assert native.jit_build() == first and len(fake.runs()) == 1
    assert {p.name for p in first.parent.iterdir()} == {first.name, "lock"}

    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.0")
    assert native.jit_build() != first
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "9.0")
    monkeypatch.setattr(torch.version, "cuda", "13.1")
    assert native.jit_build() != first
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    (fake.package / "csrc" / "cuda" / "step.h").write_text("// new")
    assert native.jit_build() != first
    (fake.package / "csrc" / "cuda" / "step.h").unlink()
    assert native.jit_build() == first and len(fake.runs()) == 4


@pytest.mark.slow
def test_jit_survives_a_killed_build(fake: Fake) -> None:
    """Both builds are processes of their own with a time limit, so that a hang fails this test, not the whole suite."""
    fake.mode("hang")
    program = (
        # the loader alone: the rest of the package takes seconds
        f"""import sys, types, torch
from pathlib import Path
from typing import Any
for name in ("diffvbd", "diffvbd.ops"):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = [{str(ROOT)!r} + "/" + name.replace(".", "/")]
from diffvbd.ops import load as native
torch.version.cuda = '13.0'
native._FOLDER = Path({str(fake.package)!r})
print(native.jit_build())"""
    )
    build = [sys.executable, "-c", program]
    victim = subprocess.Popen(build, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        end = time.monotonic() + LIMIT
        while not (fake.folder / "hanging").exists():
            assert victim.poll() is None and time.monotonic() < end
            time.sleep(0.01)
        victim.kill()  # its compiler lives on, as it does where only the process is killed
        victim.wait(LIMIT)
        fake.mode("build")
        done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT)
        assert done.returncode == 0, done.stderr
        built = Path(done.stdout.strip())
        assert built == native.jit_build()
    finally:
        victim.kill()
        for pid in fake.runs()[:1]:
            os.kill(pid, signal.SIGKILL)
    assert built.read_text() == "object 2"
    assert {p.name for p in built.parent.iterdir()} == {built.name, "lock"}


def test_jit_failure_says_why_and_can_be_repaired(fake: Fake) -> None:
    fake.mode("fail")
    assert "step.h(7): error" in message() and not list(fake.cache.rglob("*.so"))
    fake.mode("build")
    assert native.jit_build().read_text() == "object 2"


def test_jit_says_that_sources_are_missing(fake: Fake) -> None:
    shutil.rmtree(fake.package / "csrc")
    assert "no sources" in message() and "pip install" in message()
