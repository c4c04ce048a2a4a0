"""Claim: the public modules can be imported by their names, in a fresh process and in either spelling."""

import subprocess
import sys

import pytest

SPELLINGS = (
    "from diffvbd.contact import status, record; import diffvbd; assert diffvbd.contact.status is status",
    "import diffvbd.contact as c; from diffvbd import contact; assert c is contact and c.reserve",
    "import diffvbd.contact.barrier as b; import diffvbd as dv; assert b.PairBarrier is dv.PairBarrier",
    "import diffvbd.colliders as c; from diffvbd.colliders import Sphere; assert c.Sphere is Sphere",
    "from diffvbd import mesh, solvers, testing, energies, losses; assert mesh.cube and testing.evaluate",
    "import diffvbd; assert all(hasattr(diffvbd, name) for name in diffvbd.__all__)",
)


@pytest.mark.parametrize("statement", SPELLINGS)
def test_a_public_module_is_imported(statement: str) -> None:
    done = subprocess.run([sys.executable, "-W", "error", "-c", statement], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_an_unknown_name_is_named() -> None:
    import diffvbd as dv

    with pytest.raises(AttributeError, match="'diffvbd.contact' has no attribute 'stauts'"):
        _ = dv.contact.stauts  # pyright: ignore[reportAttributeAccessIssue]
