"""What each optional feature costs a step: nothing where a Model has none of it, and what it adds where it is there.

A step of two elastic bodies, 1,000 vertices in all, one face of each pinned, K = 10; every feature is added alone and
has nothing to do: bodies, floors and colliders are far from each other. Operators are those that torch dispatches (on
CUDA kernels are counted, too); bytes those of the tensors that they make, of what a backward keeps, and of the Model.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import diffvbd as dv
from bench.common import markdown_table
from bench.gpu_measure import Card

SWEEPS, TIME_STEP = 10, 5e-3
VIEWS = ("view", "expand", "slice", "select", "detach", "alias", "unsqueeze", "squeeze", "transpose", "permute", "t",
         "as_strided", "unbind", "split", "narrow", "_unsafe_view", "lift_fresh", "movedim", "unfold")  # fmt: skip


class Counted(TorchDispatchMode):
    """Operators that are dispatched inside, by name, without those that only look at a tensor otherwise; bytes of the
    storages that they make."""

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()
        self.bytes = 0
        self._kept: list[Any] = []  # so that no address comes twice
        self._known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = {t.untyped_storage().data_ptr() for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)}
        out = func(*args, **(kwargs or {}))
        namespace, name = func.name().split(".")[0].split("::")
        if namespace != "aten" or name not in VIEWS:
            self.names[f"{namespace}::{name}"] += 1
        for t in tree_leaves(out):
            if isinstance(t, Tensor) and t.numel():
                storage = t.untyped_storage()
                if storage.data_ptr() not in given | self._known:
                    self.bytes += storage.nbytes()
                    self._known.add(storage.data_ptr())
                    self._kept.append(storage)
        return out

    def own(self) -> dict[str, int]:
        """Of the package, without the others."""
        return {name: n for name, n in sorted(self.names.items()) if name.startswith("diffvbd::")}


@dataclass(frozen=True)
class Feature:
    """What one feature adds to the plain step."""

    energies: tuple[Any, ...] = ()
    model: dict[str, Any] = field(default_factory=dict)
    step: dict[str, Any] = field(default_factory=dict)
    wrt: tuple[str, ...] = ()  # what gradients are taken of
    force: bool = False
    pinned: bool = True


FLOOR, PAIRS = dv.FloorBarrier(height=-50.0), dv.PairBarrier(self_contact=False)
FEATURES: dict[str, Feature] = {
    "coarse corrections": Feature(model={"coarse": "auto"}),
    "SDIRK2": Feature(step={"integrator": dv.SDIRK2()}),
    "BDF2": Feature(step={"integrator": dv.BDF2()}),
    "rigid correction": Feature(pinned=False),
    "floor": Feature((FLOOR,)),
    "floor with friction": Feature((FLOOR, dv.Friction())),
    "anchors": Feature((dv.Anchor(),)),
    "contact of bodies": Feature((PAIRS,)),
    "contact of bodies with friction": Feature((PAIRS, dv.Friction())),
    "self-contact": Feature((dv.PairBarrier(dhat=0.01),)),
    "collider": Feature((PAIRS,), model={"colliders": (dv.colliders.Plane(point=(0.0, -50.0, 0.0)),)}),
    "force": Feature(force=True),
    "gradient of the state": Feature(wrt=("x", "v")),
    "gradient of mu and lam": Feature(wrt=("mu", "lam")),
    "gradient of mu of each tet": Feature(wrt=("mu per tet",)),
    "gradient of the force": Feature(force=True, wrt=("force",)),
    "gradient of rest_points": Feature(wrt=("rest_points",)),
    "gradient of density": Feature(wrt=("density",)),
    "gradient of a floor's kappa": Feature((FLOOR,), wrt=("floor_barrier.kappa",)),
}


def scene(feature: Feature, quick: bool, device: str) -> tuple[dv.Model, Callable[[], list[Tensor]]]:
    """A Model, and one step of it with its backward if gradients are asked for."""
    n = 4 if quick else 10
    half = dv.mesh.box((n, n, n // 2), (1.0, 1.0, 0.5), split="kuhn")
    mesh = dv.mesh.join([half, half.translate((0.0, 0.0, 20.0))])
    pinned = mesh.points[:, 0] < 1e-9 if feature.pinned else None
    model = dv.Model(mesh, pinned=pinned, energies=(dv.StableNeoHookean(), *feature.energies), device=device,
                     **feature.model)  # fmt: skip
    x = model.rest_points.clone()
    number = x.new_tensor(1e5)
    given: dict[str, Any] = {"x": x, "v": 0.1 * x, "mu": number, "lam": number.clone()}
    if feature.force:
        given["force"] = torch.zeros_like(x)
    parameters: dict[str, Tensor] = {}
    for name in feature.wrt:
        if name == "mu per tet":
            given["mu"] = number.repeat(model.num_tets)
        elif "." in name:
            parameters[name] = x.new_tensor(400.0)
        elif name not in given:
            given[name] = {"rest_points": x.clone(), "density": model.density.clone()}[name]
    leaves = [parameters[n] if "." in n else given[n.split()[0]] for n in feature.wrt]
    for leaf in leaves:
        leaf.requires_grad_()
    options = {"time_step": TIME_STEP, "sweeps": SWEEPS, **feature.step}
    if isinstance(options.get("integrator"), dv.BDF2):
        with torch.no_grad():
            x1, v1, options["history"] = dv.step(model, **given, **options)
        given["x"], given["v"] = x1, v1
    if parameters:
        options["parameters"] = parameters

    def once() -> list[Tensor]:  # with gradients enabled, so that what is kept without a leaf would be seen
        end = dv.step(model, **given, **options)
        return list(torch.autograd.grad(end[0].sum() + end[1].sum(), leaves)) if leaves else list(end[:2])

    return model, once


def counted(once: Callable[[], Any]) -> Counted:
    """Operators of a step like one that has run before, which made what lasts."""
    once()
    with Counted() as found:
        once()
    return found


def kept_bytes(once: Callable[[], Any]) -> int:
    """Bytes that the graph keeps for a backward, without what a second graph shares with it."""
    storages: list[dict[int, int]] = []
    alive: list[Tensor] = []
    for _ in range(2):
        found: dict[int, int] = {}

        def pack(t: Tensor, found: dict[int, int] = found) -> Tensor:
            storage = t.untyped_storage()
            found[storage.data_ptr()] = storage.nbytes()
            alive.append(t.detach())
            return t.detach()

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
            once()
        storages.append(found)
    first, second = storages
    return sum(size for address, size in second.items() if address not in first)


def model_bytes(model: dv.Model) -> int:
    """Bytes of the tensors of a Model that has stepped."""
    surface = [] if model.surface_of_contact is None else vars(model.surface_of_contact).values()
    return model.memory(sweeps=SWEEPS)["model"] + sum(t.nbytes for t in surface if isinstance(t, Tensor))


def kernels(once: Callable[[], Any], device: str) -> int | None:
    """Kernels of a step on CUDA; None elsewhere."""
    if torch.device(device).type != "cuda":
        return None
    activities = [torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as seen:
        once()
        torch.cuda.synchronize(device)
    return sum(e.count for e in seen.key_averages() if not e.key.startswith(("Mem", "cuda")))


def run(quick: bool, device: str = "cpu") -> dict[str, Any]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _run(quick, device)
    finally:
        torch.set_num_threads(threads)


def _run(quick: bool, device: str) -> dict[str, Any]:
    plain_model, plain = scene(Feature(), quick, device)
    counts = counted(plain)
    base = {"vertices": plain_model.num_vertices, "tets": plain_model.num_tets, "operators": counts.names.total(),
            "own": counts.own(), "kernels": kernels(plain, device), "bytes": counts.bytes, "kept": kept_bytes(plain),
            "model": model_bytes(plain_model)}  # fmt: skip
    rows = []
    for name, feature in FEATURES.items():
        model, once = scene(feature, quick, device)
        found = counted(once)
        extra = {k: n for k, n in found.own().items() if k not in counts.own()}
        without, with_it = timed(plain, once, quick, device)
        rows.append({"feature": name, "own": extra, "operators": found.names.total(),
                     "kernels": kernels(once, device), "bytes": found.bytes, "kept": kept_bytes(once),
                     "model": model_bytes(model), "without_ms": without, "with_ms": with_it})  # fmt: skip
    return {"plain": base, "rows": rows}


def timed(plain: Callable[[], Any], once: Callable[[], Any], quick: bool, device: str) -> tuple[float, float]:
    """Milliseconds of a step without and with a feature: by turns, and the best of each."""
    card, best = Card(torch.device(device), quick), [float("inf")] * 2
    clock = time.perf_counter if card.cuda else time.process_time
    for _ in range(3 if quick else 30):
        for i, work in enumerate((plain, once)):
            card.sync()
            begun = clock()
            work()
            card.sync()
            best[i] = min(best[i], 1e3 * (clock() - begun))
    return best[0], best[1]


def markdown(results: dict[str, Any]) -> str:
    base, rows = results["plain"], results["rows"]
    called = ", ".join(f"{n} x `{k.split('::')[1]}`" if n > 1 else f"`{k.split('::')[1]}`"
                       for k, n in base["own"].items())  # fmt: skip
    text = (
        f"## Absent features\n\nA plain step of {base['vertices']} vertices and {base['tets']} tets dispatches "
        f"{base['operators']} operators, of the package {called} alone; they make {base['bytes']} bytes, "
        f"{base['kept']} are kept for a backward that nobody asks for, the Model has {base['model']}. Each "
        "feature adds to it what follows; gradients with their backward.\n\n"
    )
    cuda = base["kernels"] is not None
    header = ("feature", "its operators", "operators added", "kernels added", "kB made",
              "kB kept", "kB of the Model", "ms without", "ms with", "ms added")  # fmt: skip
    table = []
    for r in rows:
        own = ", ".join(k.split("::")[1] for k in r["own"]) or "-"
        table.append((r["feature"], own, r["operators"] - base["operators"],
                      r["kernels"] - base["kernels"] if cuda else None,
                      *((r[k] - base[k]) / 1e3 for k in ("bytes", "kept", "model")), r["without_ms"], r["with_ms"],
                      r["with_ms"] - r["without_ms"]))  # fmt: skip
    return text + markdown_table(header, table)
