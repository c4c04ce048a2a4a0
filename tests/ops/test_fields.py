"""Claim: what an operator of a step takes is listed once in each language, and the lists agree."""

import re

import pytest
import torch
from helpers.paths import CSRC, needs_csrc

from diffvbd import ops

LISTS = {"SWEEP": ops.SweepFields, "STEP": ops.StepFields, "RIGID": ops.RigidFields, "BEGIN": ops.BeginFields,
         "COARSE": ops.CoarseFields}  # fmt: skip


def listed(name: str) -> list[tuple[str, str]]:
    """(ADJOINT or INDEX, field) of a list of csrc/bind/fields.h."""
    text = (CSRC / "bind" / "fields.h").read_text(encoding="utf-8").replace("\\\n", " ")
    (body,) = re.findall(rf"#define DIFFVBD_{name}_FIELDS\(ADJOINT, INDEX\)(.*)", text)
    return re.findall(r"(ADJOINT|INDEX)\((\w+)\)", body)


@needs_csrc
@pytest.mark.parametrize("name", LISTS)
def test_fields_agree(name: str) -> None:
    assert tuple(field for _, field in listed(name)) == LISTS[name]._fields


@needs_csrc
@pytest.mark.parametrize(("name", "adjoints"), [("SWEEP", ops.SWEEP_ADJOINTS), ("STEP", ops.STEP_ADJOINTS),
                                                  ("COARSE", ("x_prev", "stiffness", "mass"))])  # fmt: skip
def test_adjoints_agree(name: str, adjoints: tuple[str, ...]) -> None:
    assert tuple(field for kind, field in listed(name) if kind == "ADJOINT") == adjoints


@needs_csrc
def test_numbers_agree() -> None:
    text = (CSRC / "core" / "safeguards.h").read_text(encoding="utf-8")
    (body,) = re.findall(r"struct StepParameters \{(.*?)\n\};", text, re.DOTALL)
    kernel = re.findall(r"^\s*T (\w+);", body, re.MULTILINE)
    assert [*kernel, "friction_eps"] == list(ops.StepNumbers._fields)


@needs_csrc
def test_material_and_rest_agree() -> None:
    text = (CSRC / "energies" / "tet.h").read_text(encoding="utf-8")
    counts = {name: int(n) for name, n in re.findall(r"static constexpr int (\w+) = (\d+);", text)}
    assert counts == {"material": 2, "rest": ops.REST_SCALARS, "pair_rest": ops.PAIR_REST, "line_degree": 6}
    assert f"bool reads_x_prev = {str(ops.TET_READS_X_PREV).lower()};" in text
    assert ops.SweepFields._fields.index("lam") == ops.SweepFields._fields.index("mu") + 1


def test_there_are_four_sweep_operators() -> None:
    names = {name for name in dir(torch.ops.diffvbd) if name.startswith(("sweep", "fused"))}
    assert names == {"sweep", "sweep_backward", "fused_step", "fused_step_backward"}


@pytest.mark.parametrize(("name", "fields"), [("sweep", ops.SweepFields), ("rigid", ops.RigidFields),
                                              ("begin", ops.BeginFields)])  # fmt: skip
@pytest.mark.parametrize("end", ("", "_backward"))
def test_schemas_begin_with_the_fields(name: str, fields: type, end: str) -> None:
    assert begins_with(name + end, fields)


@pytest.mark.parametrize("name", ["contact_rigid_system", "contact_rigid_move"])
def test_schemas_of_the_rigid_contact_begin_with_the_fields(name: str) -> None:
    assert begins_with(name, ops.TouchingFields)
    assert set(ops.TOUCHING_ADJOINTS) < set(ops.TouchingFields._fields)


def begins_with(name: str, fields: type) -> bool:
    arguments = [a.name for a in getattr(torch.ops.diffvbd, name).default._schema.arguments]
    return tuple(arguments[: len(fields._fields)]) == fields._fields
