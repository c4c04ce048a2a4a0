"""Claim: the tutorials are stored without outputs, small and portable, all are in the navigation and assert what their
text says, and the first of them finds it."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from helpers.paths import ROOT

from diffvbd.testing import tolerance

FOLDER = ROOT / "docs" / "tutorials"


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_the_quickstart_finds_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        import ipykernel  # noqa: F401
        import nbclient
        import nbformat
    except ModuleNotFoundError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(f"needs {error.name}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # the kernel imports the package of this checkout
    notebook = nbformat.read(FOLDER / "quickstart.ipynb", as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    ).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    found = re.search(r"evaluations: (\S+) Pa, true (\S+) Pa", printed)
    assert found, printed
    assert float(found[1]) == pytest.approx(float(found[2]), rel=tolerance("identified_by_example"))
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 3
