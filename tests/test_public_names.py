"""Claim: the public names are few, typed and described; their modules are imported by name, in either spelling."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import diffvbd as dv
from diffvbd import distributed, results

MOST = 46  # public names beside the modules' own
# Docstrings name a thing; they do not begin with what it does.
VERB = re.compile(
    r"(Bring|Check|Compute|Draw|Fill|Get|Open|Return|Run|Save|Set|Show|Write)s? "
    r"|(Add|Evaluate|Find|Give|Look|Make|Mark|Split|Take)s? |Inside"
)

SPELLINGS = (
    "from diffvbd.contact import status; import diffvbd; assert diffvbd.contact.status is status",
    "import diffvbd.contact as c; import diffvbd as dv; assert c is dv.contact and c.forces",
    "from diffvbd import mesh, solvers, testing, energies, losses, results, distributed; assert testing.debug_checks",
    "import diffvbd; assert all(hasattr(diffvbd, name) for name in diffvbd.__all__)",
    "import diffvbd, sys; assert 'torch._dynamo' not in sys.modules",  # which takes a second to load
)
# other packages are loaded once, which takes seconds; each child process is the first to import anything of this one
SCRIPT = """
import os, sys, warnings, meshio, torch
failed = []
for statement in sys.argv[1:]:
    assert "diffvbd" not in sys.modules
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of threads, which numpy may have started and no import waits for
        child = os.fork()
    if child == 0:
        exec(statement)
        os._exit(0)
    if os.wait()[1] != 0:
        failed.append(statement)
print(failed)
"""


def test_public_modules_are_imported_and_what_is_not_there_is_noticed() -> None:
    absent = "import diffvbd.absent"
    command = [sys.executable, "-W", "error", "-c", SCRIPT, *SPELLINGS, absent]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == [repr([absent])], done.stdout + done.stderr


def test_a_folder_of_the_same_name_does_not_hide_the_package(tmp_path: Path) -> None:
    """As beside a clone of the repository: a script there imports what is installed, from sources in place, too."""
    (tmp_path / "diffvbd").mkdir()
    script = "import importlib.util as util; print(util.find_spec('diffvbd').origin)"
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert Path(done.stdout.strip()).name == "__init__.py", done.stdout + done.stderr


def test_an_unknown_name_is_named() -> None:
    with pytest.raises(AttributeError, match="'diffvbd.contact' has no attribute 'stauts'"):
        _ = dv.contact.stauts  # pyright: ignore[reportAttributeAccessIssue]


def test_public_names_are_few() -> None:
    assert dir(dv) == sorted(dir(dv)) and len(dir(dv)) <= MOST
    assert not [name for name in dir(dv) if name.startswith("_")]


PUBLIC = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in (dv, dv.colliders, dv.contact, distributed, dv.mesh, results, dv.solvers, dv.viz)
    for name in module.__all__
    if callable(getattr(module, name))
}


@pytest.mark.parametrize("name", PUBLIC)
def test_public_things_are_typed_and_described(name: str) -> None:
    thing = PUBLIC[name]
    signature = inspect.signature(thing)
    untyped = [p.name for p in signature.parameters.values() if p.annotation is p.empty]
    assert not untyped and (inspect.isclass(thing) or signature.return_annotation is not signature.empty)
    text = inspect.getdoc(thing) or ""
    assert text[:1].isupper() and (text.startswith("Checks of") or not VERB.match(text)), text[:60]
