"""Identifying a material with steps that are too long, and with settings that resolve the motion, for `bench advice`.

A bunny is dropped on a floor; its shapes of 0.3 s are those of 480 steps. Young's modulus and Poisson's ratio are
fitted to them from the same first guess, each time with other settings: by L-BFGS with gradients of the reverse sweep,
and by Gauss-Newton, whose two columns are differences of three scenes that run as one batch.
"""

from __future__ import annotations

import time
import warnings
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv

Row = dict[str, Any]
YOUNG, POISSON = 5e4, 0.3  # of the target [Pa], [-]
FIRST = (2e4, 0.4)  # the first guess
DURATION, FRAMES = 0.3, 12  # [s]; shapes that are seen
DHAT = 2e-3  # [m]
APART = 1e-4  # of log E and nu, for differences
LONGEST = 0.5  # way of log E and nu in one iteration


def scene(cells: int) -> dv.Model:
    body = dv.mesh.bunny(cells, 0.2)
    body = body.translate((0, 0.02 - body.points[:, 1].min(), 0))
    return dv.Model(body, energies=(dv.StableNeoHookean(), dv.FloorBarrier(kappa=1e3, dhat=DHAT)))


def shapes(model: dv.Model, settings: dv.Settings, young: Any, poisson: Any) -> Tensor:
    """[FRAMES, ..., V, 3]; young and poisson are numbers, or of shape [B, 1]."""
    lead = torch.as_tensor(young).shape[:-1]
    x, steps = model.rest_points.expand(*lead, -1, -1), settings.steps(DURATION)
    out = dv.rollout(model, x, torch.zeros_like(x), duration=DURATION, settings=settings, save=steps // FRAMES,
                     young=young, poisson=poisson)  # fmt: skip
    return out.x[1:]


class Fit:
    """log E and nu, and how far the shapes that they give are from a target."""

    def __init__(self, model: dv.Model, target: Tensor) -> None:
        self.model, self.target = model, target
        self.scale = (target - model.rest_points).square().sum()
        self.q = torch.tensor([FIRST[0], FIRST[1]], dtype=torch.float64)
        self.q[0] = self.q[0].log()

    def loss(self, q: Tensor, settings: dv.Settings) -> Tensor:
        return (shapes(self.model, settings, q[0].exp(), q[1]) - self.target).square().sum() / self.scale

    def lbfgs(self, settings: dv.Settings, most: int) -> int:
        """Returns the number of evaluations. nu is kept in (0, 0.49) by a sigmoid."""
        p = torch.stack([self.q[0], torch.logit(self.q[1] / 0.49)]).requires_grad_()
        optimizer = torch.optim.LBFGS([p], max_iter=most, max_eval=most, tolerance_grad=1e-7, tolerance_change=1e-10,
                                      line_search_fn="strong_wolfe")  # fmt: skip
        calls = 0

        def evaluated() -> Tensor:
            nonlocal calls
            calls += 1
            optimizer.zero_grad()
            value = self.loss(torch.stack([p[0], 0.49 * torch.sigmoid(p[1])]), settings)
            value.backward()
            return value

        optimizer.step(evaluated)
        self.q = torch.stack([p[0], 0.49 * torch.sigmoid(p[1])]).detach()
        return calls

    @torch.no_grad()
    def gauss_newton(self, settings: dv.Settings, most: int) -> int:
        """Returns the number of iterations, of three scenes each. Where the loss rises, half of the way is taken."""
        best, way, apart = torch.inf, torch.zeros(2, dtype=torch.float64), APART * torch.eye(2, dtype=torch.float64)
        for taken in range(1, most + 1):
            trial = torch.stack([self.q + way, self.q + way + apart[0], self.q + way + apart[1]])
            off = shapes(self.model, settings, trial[:, :1].exp(), trial[:, 1:]) - self.target[:, None]
            off = off.transpose(0, 1).reshape(3, -1)
            loss = float(off[0].square().sum() / self.scale)
            if loss > best:
                way = 0.5 * way
                continue
            best, self.q = loss, trial[0]
            columns = (off[1:] - off[:1]).T / APART
            way = torch.linalg.lstsq(columns, -off[0][:, None]).solution[:, 0]
            way = way * min(1.0, LONGEST / float(way.abs().max()))
            way[1] = way[1].clamp(-0.5 * self.q[1], 0.5 * (0.49 - self.q[1]))
            if float(way.abs().max()) < 1e-4:
                return taken
        return most


Stages = list[tuple[str, dv.Settings, int]]  # method, settings, and the most evaluations; each starts where one ended


def fitted(model: dv.Model, target: Tensor, stages: Stages) -> Row:
    """Young's modulus and Poisson's ratio, what they took, and how well they fit."""
    fit, began = Fit(model, target), time.perf_counter()
    counts = [(fit.lbfgs if method == "L-BFGS" else fit.gauss_newton)(settings, most)
              for method, settings, most in stages]  # fmt: skip
    seconds = time.perf_counter() - began
    young, poisson = float(fit.q[0].exp()), float(fit.q[1])
    with torch.no_grad():
        left = float(fit.loss(fit.q, stages[-1][1])) ** 0.5
    told = "; then ".join(f"{method}, {settings}" for method, settings, _ in stages)
    return {"fit": told, "evaluations": counts, "young": young, "poisson": poisson, "young_off": young / YOUNG - 1,
            "poisson_off": poisson - POISSON, "left": left, "seconds": seconds}  # fmt: skip


def ways() -> list[Stages]:
    """The first is what one would do without a look at the time step."""

    def euler(steps: int, sweeps: int) -> dv.Settings:
        return dv.Settings(DURATION / steps, sweeps)

    def sdirk(steps: int, sweeps: int) -> dv.Settings:
        return dv.Settings(DURATION / steps, sweeps, dv.SDIRK2())

    return [
        [("L-BFGS", euler(60, 20), 40)],
        [("Gauss-Newton", euler(60, 20), 12)],
        [("L-BFGS", euler(480, 5), 40)],
        [("Gauss-Newton", euler(480, 5), 12)],
        [("Gauss-Newton", sdirk(240, 5), 12)],
        [("Gauss-Newton", euler(60, 5), 8), ("Gauss-Newton", euler(480, 5), 4)],
    ]


def fit(quick: bool) -> list[Row]:
    model = scene(8 if quick else 20)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with torch.no_grad():
            target = shapes(model, dv.Settings(DURATION / 480, 20), YOUNG, POISSON)
        quickly: list[Stages] = [[(m, dv.Settings(DURATION / 60, 5), 2)] for m in ("L-BFGS", "Gauss-Newton")]
        rows = [fitted(model, target, stages) for stages in (quickly if quick else ways())]
    return [row | {"vertices": model.num_vertices, "over_first": row["seconds"] / rows[0]["seconds"]} for row in rows]
