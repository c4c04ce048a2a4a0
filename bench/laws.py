"""Laws of one's own: time of a step relative to the built-in law on one core or on a GPU, and time to compile.

The clamped cube of `python -m bench cpu`, slightly off rest, at K = 20. "Stable Neo-Hookean" is the built-in law
written as a law of one's own: the two compute the same. Times are processor time of the thread, the least of several
rounds that visit all laws in turn; on a GPU the wall clock of a cube of 33^3 vertices. Compile times are into an empty
folder: wall clock, and processor time of all cores, about twice the wall clock of two idle ones.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import torch
from torch import Tensor

import diffvbd as dv
from bench import measure
from bench.measure import Card
from bench.tables import Row, Table

SWEEPS, MODULI = 20, {"mu": 1e5, "lam": 1e5}
NEO_HOOKEAN = "mu/2*(I1 - 3) - mu*log(J) + lam/2*log(J)**2"
LAWS: dict[str, tuple[str, dict[str, Any]]] = {
    "stable Neo-Hookean": ("mu/2*(I1 - 3) - mu*(J - 1) + (mu + lam)/2*(J - 1)**2", MODULI),
    "Mooney-Rivlin, polynomial": ("C10*(I1 - 3) + C01*(I2 - 3) - 2*(C10 + 2*C01)*(J - 1) + K/2*(J - 1)**2",
                                  {"C10": 4e4, "C01": 1e4, "K": 2e5}),
    "logarithmic Neo-Hookean": (NEO_HOOKEAN, MODULI),
    "corotated": ("mu*(I1 - 2*trU + 3) + lam/2*(trU - 3)**2", MODULI),
    "Mooney-Rivlin": ("C10*(I1*J**(-2/3) - 3) + C01*(I2*J**(-4/3) - 3) + K/2*(J - 1)**2",
                      {"C10": 4e4, "C01": 1e4, "K": 2e5}),
    "fibres": (NEO_HOOKEAN + " + k1/(2*k2)*(exp(k2*(I4 - 1)**2) - 1)", {**MODULI, "k1": 1e5, "k2": 1.0}),
}  # fmt: skip
TABLES = (
    Table("Laws of your own", "rows", {
        "law": "law", "forward [ms]": "forward_ms", "over the built-in": "forward_ratio",
        "forward and backward [ms]": "both_ms", "over it": "both_ratio", "compile, processor time [s]": "compile_cpu_s",
    }),
)  # fmt: skip


def step_of(model: dv.Model, x: Tensor, given: dict[str, float], differentiated: bool) -> Callable[[], None]:
    """A step, with gradients of state and parameters of each tet or without any."""
    v, solver = torch.zeros_like(x), dv.VBD(5e-3, SWEEPS)
    leaves: dict[str, Any] = dict(given)
    if differentiated:
        x = x.clone().requires_grad_()
        leaves = {k: x.detach().new_full((model.num_tets,), m).requires_grad_() for k, m in given.items()}

    def work() -> None:
        end, _ = dv.step(model, x, v, solver, **leaves)
        if differentiated:
            torch.autograd.grad(end.sum(), (x, *leaves.values()))

    return work


def of_children() -> float:
    """Processor time of processes that have ended [s]."""
    now = os.times()
    return now.children_user + now.children_system


def compiled(names: list[str], mesh: dv.TetMesh, card: Card) -> tuple[dict[str, dv.Model], dict[str, Any]]:
    """Models by the name of their law, and how long each took to compile [s]: wall clock, processor time."""
    pinned = torch.from_numpy(mesh.points[:, 1] < 1e-9)
    models, took = {"built-in": dv.Model(mesh, pinned=pinned, device=card.device)}, {}
    with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, TORCH_EXTENSIONS_DIR=folder):
        for name in names:
            text, values = LAWS[name]
            law = dv.law(text, **values, **({"a0": (1.0, 0.0, 0.0)} if "I4" in text else {}))
            start, used = time.perf_counter(), of_children()
            models[name] = dv.Model(mesh, pinned=pinned, energies=(law,), device=card.device)
            step_of(models[name], models[name].rest_points, values, False)()  # CUDA compiles at the first step
            took[name] = time.perf_counter() - start, of_children() - used
    return models, took


def laws(card: Card) -> list[Row]:
    mesh = dv.mesh.cube(6 if card.quick else 33 if card.cuda else 17, split="five")
    models, took = compiled(list(LAWS)[: 1 if card.quick else 2 if card.cuda else len(LAWS)], mesh, card)
    rest = models["built-in"].rest_points
    noise = torch.randn(rest.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(rest)
    times: dict[tuple[str, bool], float] = {}
    for _ in range(2 if card.quick else 7):
        for name, model in models.items():
            for differentiated in (False, True):
                work = step_of(model, rest + 1e-3 * noise, LAWS[name][1] if name in LAWS else MODULI, differentiated)
                work()
                seconds = card.eager(work, 10) if card.cuda else measure.timed(work, time.thread_time)
                times[name, differentiated] = min(seconds, times.get((name, differentiated), seconds))
    rows = []
    for name in models:
        forward, both = (times[name, d] for d in (False, True))
        wall, used = took.get(name, (None, None))
        rows.append({"law": name, "tets": mesh.num_tets, "forward_ms": 1e3 * forward, "both_ms": 1e3 * both,
                     "forward_ratio": forward / times["built-in", False], "both_ratio": both / times["built-in", True],
                     "compile_s": wall, "compile_cpu_s": used})  # fmt: skip
    return rows


GROUPS = {"rows": laws}
THREADS, ANYWHERE = 1, True
