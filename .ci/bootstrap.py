"""Create an environment that can build diffvbd: `python3 .ci/bootstrap.py .venv` (`make` calls it).

A torch that the calling Python can import is reused; otherwise one is installed, the CPU build where no NVIDIA GPU is
seen. Running it again on a complete environment changes nothing and takes seconds.

Environment variables:
    TORCH_SPEC  what pip installs when torch is missing, e.g. "torch==2.12.0" (default: TORCH below).
    PIP_*       read by pip as usual, e.g. PIP_EXTRA_INDEX_URL for PyTorch's index of CPU wheels.
"""

import importlib.metadata
import importlib.util
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

TORCH = "torch==2.13.0"
MINIMUM_TORCH = (2, 11)
# torch 2.11 does not accept setuptools 82.
BUILD_TOOLS = ("setuptools>=77,<82", "ninja")


def main() -> None:
    if sys.version_info < (3, 10):  # noqa: UP036
        sys.exit(f"diffvbd needs Python >= 3.10, got {sys.version.split()[0]}; name another: make PYTHON=python3.12")
    root = Path(sys.argv[1]).absolute()
    python = root / "bin" / "python"
    if not python.exists():
        create(root)
    if not has_torch(python) and not share_torch(root):
        install_torch(python)
    pip(python, *BUILD_TOOLS)


def create(root: Path) -> None:
    say(f"creating {root.name} with Python {sys.version.split()[0]}")
    try:
        venv.create(root, with_pip=True)
    except subprocess.CalledProcessError:
        shutil.rmtree(root, ignore_errors=True)
        sys.exit("this Python cannot create environments with pip; on Debian and Ubuntu: apt install python3-venv")


def has_torch(python: Path) -> bool:
    probe = "import importlib.util as u, sys; sys.exit(u.find_spec('torch') is None)"
    return subprocess.run([python, "-c", probe]).returncode == 0


def share_torch(root: Path) -> bool:
    """Let the environment see the calling Python's torch; True if there is one that is new enough."""
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        return False
    version = importlib.metadata.version("torch")
    if tuple(int(part) for part in version.split("+")[0].split(".")[:2]) < MINIMUM_TORCH:
        say(f"torch {version} of the calling Python is too old; installing another")
        return False
    # A venv made from a venv does not see the outer one's packages; a .pth file does it for every kind of Python.
    site = Path(spec.origin).parents[1]
    target = next((root / "lib").glob("python*/site-packages")) / "shared-torch.pth"
    target.write_text(f"{site}\n")
    say(f"using torch {version} of {sys.executable}")
    return True


def install_torch(python: Path) -> None:
    chosen = os.environ.get("TORCH_SPEC")
    if chosen is None and shutil.which("nvidia-smi") is None and sys.platform == "linux":
        # The +cpu wheels are on PyTorch's own index; where pip is not set up for it, the plain version is next.
        say(f"no NVIDIA GPU: looking for {TORCH}+cpu")
        if pip(python, f"{TORCH}+cpu", check=False):
            return
        say("pip finds no CPU wheel (PIP_EXTRA_INDEX_URL can name PyTorch's CPU index); installing the default build")
    pip(python, chosen or TORCH)


def pip(python: Path, *requirements: str, check: bool = True) -> bool:
    command = [python, "-m", "pip", "install", "-qq", "--disable-pip-version-check", *requirements]
    output = None if check else subprocess.DEVNULL
    done = subprocess.run(command, stdout=output, stderr=output)
    if check and done.returncode != 0:
        sys.exit(f"pip could not install {' '.join(requirements)}")
    return done.returncode == 0


def say(text: str) -> None:
    print(f"bootstrap: {text}", flush=True)


if __name__ == "__main__":
    main()
