"""A copy of the sources that a test changes, builds by the command of docs/guides/extend.md, and runs."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from helpers.paths import ROOT


def copy_sources(to: Path) -> None:
    for name in ("csrc", "diffvbd"):
        shutil.copytree(ROOT / name, to / name, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name in ("setup.py", "pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, to)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1, f"{path.name}: {old}"
    path.write_text(text.replace(old, new), encoding="utf-8")


def build(root: Path) -> None:
    page = (ROOT / "docs" / "guides" / "extend.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^(DIFFVBD_QUICK=1) python (setup.py .*)$", page, re.MULTILINE)
    line = f"{command[0]} {shlex.quote(sys.executable)} {command[1]}"
    done = subprocess.run(line, shell=True, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def run(root: Path, script: str) -> str:
    """What the script prints; it imports the copy."""
    environment = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", script], cwd=root, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout
