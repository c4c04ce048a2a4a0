"""Claim: an energy added as docs/guides/extend.md says works, and leaves contact working.

The docs' own example, Anchor, is added once more under another name, in a copy of the sources, which is then built.
"""

import re
from pathlib import Path

import pytest
import torch
from helpers.copied_sources import build, copy_sources, edit, run
from helpers.paths import needs_csrc

from diffvbd.energies import Anchor, VertexEnergy

SCRIPT = """
import warnings

import torch
import diffvbd as dv
from diffvbd.testing.contact_scenes import boxes, build, compiled, unrolled
from diffvbd.energies import Tether
from diffvbd.rollout.refine import halved
from diffvbd.testing import relative_error, tolerance

SOLVER = dv.VBD(0.01, 3)
assert [e.bit for e in dv.energies.VERTEX_ENERGIES] == [8, 16, 32] and dv.PairBarrier.bit == 4
floor, pairs = dv.FloorBarrier(height=-0.015, kappa=3e4, dhat=0.02, damping=2.0), dv.PairBarrier(kappa=3e4, dhat=0.02)

def scene_of(*energies):
    scene = build("third", boxes((0, 0, 0), (0.03, 0.213, 0.02)), energies, jitter=3e-3)
    for name in ("anchor", "tether"):
        if any(getattr(e, "name", "") == name for e in energies):
            scene.parameters[f"{name}_stiffness"] = torch.full((54,), 50.0, dtype=torch.float64)
    return scene

results = {}
for kind in (dv.Anchor, Tether):
    for more in ((), (floor,)):
        results[kind.name, bool(more)], parts = compiled(scene_of(*more, pairs, kind(50.0)), 2, SOLVER)
        assert any(len(part.pairs) for step in parts for part in step)
for name, one in results.items():
    other = results["anchor", name[1]]
    for key, value in one.items():
        assert torch.equal(value, other[key.replace("tether", "anchor")]), (name, key)
    assert one[f"grad_{name[0]}_stiffness"].abs().max() > 0

scene = scene_of(floor, pairs, dv.Anchor(50.0), Tether(30.0))
result, parts = compiled(scene, 2, SOLVER)
for key, value in unrolled(scene, 2, SOLVER, parts).items():
    assert value.abs().max() > 0 and relative_error(result[key], value) <= tolerance("contact_adjoint"), key
# It stores energy, which no check may take for an error of the sweeps, and a finer mesh has no data for its vertices.
mesh = dv.mesh.beam(3, 2, 2, size=(0.2, 0.1, 0.1))
model = dv.Model(mesh, energies=(dv.StableNeoHookean(), Tether(50.0, points=torch.as_tensor(mesh.points) + 1.0)))
x, rest = model.rest_points, dict(mu=1e4, lam=1e4, gravity=torch.zeros(3, dtype=torch.float64))
with warnings.catch_warnings():
    warnings.simplefilter("error")
    motion = dv.rollout(model, x, torch.zeros_like(x), SOLVER, steps=20, **rest)
assert motion.v[-1].norm() > 1
try:
    halved(model)
except ValueError as error:
    assert "mesh" in str(error) and "Tether" in str(error)
else:
    raise AssertionError("expected a ValueError")
print("a third energy and contact")
"""


def renamed(text: str) -> str:
    return text.replace("Anchor", "Tether").replace("anchor", "tether")


def class_of(path: Path, name: str) -> str:
    """Source of a class up to the next statement of the module, with its decorators."""
    (found,) = re.findall(rf"(?:^@[^\n]*\n)*^class {name}\b.*?(?=^\S(?<!\)))", path.read_text(encoding="utf-8"),
                          re.MULTILINE | re.DOTALL)  # fmt: skip
    return found


def add_an_energy(root: Path) -> None:
    """The four places of docs/guides/extend.md."""
    energies = root / "csrc" / "energies"
    header = (energies / "anchor.h").read_text(encoding="utf-8")
    (energies / "tether.h").write_text(renamed(header), encoding="utf-8")
    edit(energies / "tether.h", "      const R k = s.h * s.h * data[i];\n",
         "      R k = R(0);\n      k += select(data[i] > R(0), s.h * s.h * data[i], R(0));\n")  # fmt: skip
    edit(energies / "energies.h", '#include "anchor.h"', '#include "anchor.h"\n#include "tether.h"')
    edit(energies / "energies.h", "EnergyList<FloorBarrier, Anchor>", "EnergyList<FloorBarrier, Anchor, Tether>")
    python, reference = root / "diffvbd" / "energies.py", root / "diffvbd" / "reference" / "energies.py"
    edit(python, "\nVERTEX_ENERGIES:", "\n" + renamed(class_of(python, "Anchor")) + "\nVERTEX_ENERGIES:")
    edit(python, "(FloorBarrier, Anchor)", "(FloorBarrier, Anchor, Tether)")
    edit(reference, "\nENERGIES:", "\n" + renamed(class_of(reference, "Anchor")) + "\nENERGIES:")
    edit(reference, '"anchor": Anchor,', '"anchor": Anchor, "tether": Tether,')


def test_blocks_that_an_energy_does_not_have_follow_from_its_gradient() -> None:
    x, k = (torch.randn(2, 5, n, dtype=torch.float64, requires_grad=True) for n in (3, 4))
    energy, given = Anchor(50.0), (x, x, k.flatten(1), 0.1, None)
    for found, own in zip(*(_with_gradients(kind.blocks(energy, *given), x, k) for kind in (VertexEnergy, Anchor)),
                          strict=True):  # fmt: skip
        assert torch.equal(found, own.expand(found.shape))


def _with_gradients(blocks: torch.Tensor, *inputs: torch.Tensor) -> list[torch.Tensor]:
    loss = (blocks * torch.arange(9.0, dtype=blocks.dtype).reshape(3, 3)).sum()
    return [blocks, *torch.autograd.grad(loss, inputs, allow_unused=True, materialize_grads=True)]


@pytest.mark.slow
@needs_csrc
def test_a_third_energy_of_single_vertices_and_contact(tmp_path: Path) -> None:
    copy_sources(tmp_path)
    add_an_energy(tmp_path)
    build(tmp_path)
    assert "a third energy and contact" in run(tmp_path, SCRIPT)
