"""What each rule of a contact step is for: the gates of motion, loads and crowds with one rule off at a time.

The group "start" in the results is of the start before one step fraction a body took its place, at the commit that it
names; the rules that no gate needed are gone.

A row says how many gates are not met without the rule, and by how much results moved from those with it: the median and
the largest of |value - value with all rules| over the larger of both, of the gates whose value is above 1e-6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest import mock

import numpy as np
import torch

from bench import common, contact_gates
from bench.measure import Card
from bench.tables import Table
from diffvbd.adjoint.potential import IncreaseInputs
from diffvbd.step import contact

Row = dict[str, Any]


def unchanged(*given: Any) -> Any:
    return nullcontext()


@contextmanager
def start_with(**changes: Callable[..., Any]) -> Iterator[None]:
    """Arguments of the start of a substep replaced by functions of themselves and of all."""
    work = contact.start_substep
    names = ("x", "move", "u", "rigid", "trust_radius", "deformation_radius", "floor", "origin", "collider",
             "collider_next", "pinned", "body", "unit", "listed")  # fmt: skip

    def run(*values: Any) -> Any:
        given = dict(zip(names, values, strict=True))
        return work(**(given | {key: change(given[key], given) for key, change in changes.items()}))

    with mock.patch.object(contact, "start_substep", run):
        yield


def none(value: Any, given: dict[str, Any]) -> Any:
    return 0 * value


def at_rest(move: Any, given: dict[str, Any]) -> Any:
    body, pinned = (given[name][: move.shape[1]] for name in ("body", "pinned"))
    held = torch.isin(body, body[pinned])
    return torch.where(held[:, None], move, 0.0)


def each_vertex(unit: Any, given: dict[str, Any]) -> Any:
    return torch.arange(len(unit), dtype=torch.int32, device=unit.device)


@contextmanager
def no_first_correction() -> Iterator[None]:
    start, work, first = contact.start_substep, contact.corrected, [False]

    def started(*given: Any) -> Any:
        first[0] = True
        return start(*given)

    def after(of: Any, x: Any, *given: Any, **options: Any) -> Any:
        made, skips, first[0] = work(of, x, *given, **options), first[0], False
        return made._replace(x=x) if skips else made

    with mock.patch.multiple(contact, start_substep=started, corrected=after):
        yield


@contextmanager
def numbers(module: Any, **values: Any) -> Iterator[None]:
    with mock.patch.multiple(module, **values):
        yield


def with_gravity(of: Any, h2a: Any) -> Any:
    """_wanted() as if no body were partly pinned."""
    return of.begun.y - of.x_prev - h2a, None


RULES: dict[str, Callable[[], Any]] = {
    "none: all rules": unchanged,
    "free bodies start by their inertia": lambda: start_with(
        move=at_rest, rigid=none, u=none),
    "one step fraction for a free body": lambda: start_with(unit=each_vertex),
    "translation of islands": lambda: start_with(u=none),
    "gravity at the start of pinned bodies": lambda: numbers(contact.ContactStep, _wanted=with_gravity),
    "pinned bodies at rest start without gravity": lambda: numbers(
        IncreaseInputs, increases_potential=lambda self, x, to: torch.zeros(x.shape[:2], dtype=torch.bool,
                                                                            device=x.device)),
    "rigid correction before the sweeps": no_first_correction,
    "more substeps while vertices are truncated": lambda: numbers(contact, MOST_DETECTIONS=0),
}  # fmt: skip


def cases() -> list[contact_gates.Case]:
    """With at most 12 sweeps: rules are for few."""
    every = [*contact_gates.motion(False), *contact_gates.borne(False),
             *contact_gates.every(contact_gates.crowd, sweeps=[8], way=[*contact_gates.WAYS])]  # fmt: skip
    return [case for case in every if case[1]["sweeps"] <= 12]


def without(case: tuple[str, int], device: str) -> list[Row]:
    rule, number = case
    with RULES[rule]():
        rows, _ = contact_gates.measured((number, *cases()[number]), device)
    return [{"case": f"{row['gate']}: {row['case']}", "value": row["value"], "met": row["met"]} for row in rows]


def rules(card: Card) -> list[Row]:
    count = 4 if card.quick else len(cases())
    asked = [(rule, n) for rule in RULES for n in range(count)]
    found: dict[str, dict[str, Row]] = {rule: {} for rule in RULES}
    for (rule, _), rows in common.side_by_side(without, asked, str(card.device), at_once=not card.quick):
        found[rule] |= {row["case"]: row for row in rows}
    base, out = found["none: all rules"], []
    for rule, rows in found.items():
        missed = sorted(name for name, row in rows.items() if not row["met"])
        moved = {
            name: abs(row["value"] - base[name]["value"]) / max(abs(row["value"]), abs(base[name]["value"]))
            for name, row in rows.items()
            if name in base
            and row["value"] is not None
            and base[name]["value"] is not None
            and max(abs(row["value"]), abs(base[name]["value"])) > 1e-6
        }
        most = max(moved, key=lambda name: moved[name], default="")
        out.append({"rule": rule, "gates": len(rows), "not met": len(missed), "which": "; ".join(missed[:4]),
                    "median": float(np.median([*moved.values()])) if moved else math.nan,
                    "largest": moved.get(most, math.nan), "of": most})  # fmt: skip
    return out


GROUPS = {"step": rules}
THREADS, ANYWHERE = 1, True
TABLES = (Table("Gates without a rule: {}", "*", ("rule", "gates", "not met", "which", "median", "largest", "of")),)
