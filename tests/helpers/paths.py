"""Where the checkout is, and what may be missing of it."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE, TESTS, CSRC = ROOT / "diffvbd", ROOT / "tests", ROOT / "csrc"
needs_csrc = pytest.mark.skipif(not CSRC.exists(), reason="the C++ sources are not here")
