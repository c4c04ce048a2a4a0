"""Laws of one's own in tests: compiled once for all processes of a session, in a temporary folder."""

import os
from collections.abc import Iterator

import pytest

STABLE = "mu/2*(I1 - 3) - mu*(J - 1) + (mu + lam)/2*(J - 1)**2"


@pytest.fixture(scope="module", autouse=True)
def compiled_laws(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    own = tmp_path_factory.getbasetemp()
    shared = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own  # by the processes of the session
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_EXTENSIONS_DIR", str(shared / "laws"))
        yield
