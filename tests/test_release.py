"""Claim: the version stands in one place, what describes the package agrees, and an sdist has all that builds it."""

import re
import runpy
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from helpers.copied_sources import copy_sources
from helpers.paths import ROOT, needs_csrc

import diffvbd

WHEELS = runpy.run_path(str(ROOT / ".ci" / "wheels.py"))
BOOTSTRAP = runpy.run_path(str(ROOT / ".ci" / "bootstrap.py"))


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_version_stands_in_one_place() -> None:
    version = diffvbd.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+(-[\w.]+)?", version)
    assert text("diffvbd/_version.py").count(f'"{version}"') == 1
    for name in ("pyproject.toml", "CITATION.cff", "setup.py", ".github/workflows/release.yml"):
        assert not re.search(rf"(?<![\d.]){re.escape(version)}(?![\d.])", text(name)), name


def test_the_citation_agrees_with_the_project() -> None:
    project = dict(re.findall(r'^(name|license|description) = "(.*)"$', text("pyproject.toml"), re.MULTILINE))
    citation = text("CITATION.cff")
    assert f"title: {project['name']}\n" in citation
    assert f"license: {project['license']}\n" in citation
    assert project["description"] in citation
    (author,) = re.findall(r'^authors = \[\{ name = "(.*)" \}\]$', text("pyproject.toml"), re.MULTILINE)
    assert f"  - name: {author}\n" in citation


def test_the_oldest_torch_and_python_are_the_same_everywhere() -> None:
    oldest, workflow = WHEELS["OLDEST_TORCH"], text(".github/workflows/release.yml")
    short = ".".join(map(str, BOOTSTRAP["MINIMUM_TORCH"]))
    assert oldest.startswith(f"{short}.")
    assert f'"torch>={short}"' in text("pyproject.toml")
    assert f"TORCH_SPEC: torch=={oldest}\n" in workflow and f'torch: ["{oldest}", ' in workflow
    (python,) = re.findall(r'requires-python = ">=(.*)"', text("pyproject.toml"))
    assert f'python: ["{python}", ' in workflow


@pytest.mark.slow
@needs_csrc
def test_an_sdist_has_what_builds_it(tmp_path: Path) -> None:
    copy_sources(tmp_path)
    for name in ("LICENSE", "CHANGELOG.md", "CITATION.cff", "MANIFEST.in"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "docs").mkdir()
    for page in (ROOT / "docs").glob("*.md"):
        shutil.copy(page, tmp_path / "docs")
    done = subprocess.run([sys.executable, "setup.py", "-q", "sdist"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    (sdist,) = (tmp_path / "dist").glob("*.tar.gz")
    assert sdist.name == f"diffvbd-{diffvbd.__version__}.tar.gz"
    WHEELS["check_sdist"](sdist)
    build = [sys.executable, "setup.py", "-q", "build_py", "--build-lib", "built"]
    subprocess.run(build, cwd=tmp_path, check=True, capture_output=True)
    for folder, pattern in (("csrc", "*.h"), ("docs", "*.md")):
        packed = {path.name for path in (tmp_path / "built" / "diffvbd" / folder).rglob(pattern)}
        assert packed == {path.name for path in (tmp_path / folder).rglob(pattern)}
    with tarfile.open(sdist) as archive:
        information = archive.extractfile(f"{sdist.name.removesuffix('.tar.gz')}/PKG-INFO")
        assert information is not None
        described = information.read().decode("utf-8")
    assert "Description-Content-Type: text/markdown\n" in described
    # README.md, whose links are text: a package index has no other file of the sources
    assert "](docs/install.md)" in text("README.md") and "![" in text("README.md")
    assert "* Identify materials from measured motion." in described and "\nheight.backward()" in described
    assert "](" not in described
