"""Claim: a free body that hits a floor in short steps rebounds as converged steps have it, at few sweeps. Where planes
hold it back, its vertices start each by itself if tets hardly resist within the step, and the derivative is that."""

from typing import Any

import pytest
import torch
from helpers.spreads import beyond, errors_between
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import diffvbd as dv
from diffvbd import reference
from diffvbd.testing import generator, relative_error, tolerance

SPEED, DHAT = 2.4, 5e-3  # of a fall over 0.3 m [m/s]; [m]
KAPPA, SHORT = 1e3, 1e-4  # [N/m], [s]
MESHES = {"ball": dv.mesh.blob(4, radius=0.1), "cube": dv.mesh.cube(4, size=0.2)}


class Decisions(TorchDispatchMode):
    """Which corrected bodies of which scenes started vertex by vertex, of each step [scenes, bodies]."""

    def __init__(self) -> None:
        super().__init__()
        self.alone: list[Tensor] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if getattr(func, "_opname", "") == "begin":
            self.alone.append(out[3].bool().cpu())
        return out


def falling(mesh: dv.TetMesh, device: str, gap: float = 1.2 * DHAT) -> tuple[dv.Model, Tensor, Tensor]:
    floor = dv.FloorBarrier(height=0.0, kappa=KAPPA, dhat=DHAT)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), floor), device=device)
    x = model.rest_points.clone()
    x[:, 1] += gap - x[:, 1].min()
    v = torch.zeros_like(x)
    v[:, 1] = -SPEED
    return model, x, v


def held(model: dv.Model, x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """The state some steps after the first one that starts vertex by vertex."""
    steps = 0
    while steps < 5:
        with torch.no_grad(), Decisions() as seen:
            x, v = dv.step(model, x, v, dv.VBD(SHORT, 5), mu=1e5, lam=2e5)
        steps += bool(seen.alone[0].any())
    return x, v


@pytest.mark.parametrize("name", MESHES)
def test_a_drop_in_short_steps(device: str, name: str) -> None:
    """Ways of all vertices until the body has left the floor, beside converged ones."""

    def end(sweeps: int) -> tuple[Tensor, Tensor, list[Tensor]]:
        model, x, v = falling(MESHES[name], device)
        with torch.no_grad(), Decisions() as seen:
            last = dv.rollout(model, x, v, dv.VBD(SHORT, sweeps), mu=1e5, lam=2e5, steps=400, save="last")
        return last.x[-1] - x, last.v[-1], seen.alone

    goal, velocity, _ = end(15)
    assert float(velocity[:, 1].mean()) > 0.3 * SPEED  # it rebounds
    for sweeps, bar in ((2, "impact_of_two_sweeps"), (5, "impact")):
        moved, _, alone = end(sweeps)
        assert sum(bool(a.all()) for a in alone) > 10
        assert relative_error(moved, goal) <= tolerance(bar)


def test_what_is_soft_within_a_step_decides(device: str) -> None:
    """By scenes: a soft body at the floor starts vertex by vertex, a stiff one and one in flight do not; alone each
    has the same bits. Longer steps do not either."""
    model, x, v = falling(MESHES["ball"], device)
    x, v = held(model, x, v)
    xs = torch.stack([x, x, x + torch.tensor([0.0, 0.1, 0.0]).to(x)])
    vs, mu = v.expand_as(xs), torch.tensor([[1e5], [1e9], [1e5]]).to(x)

    def step(rows: Any, h: float) -> tuple[Tensor, Tensor]:
        with Decisions() as seen:
            end = dv.step(model, xs[rows], vs[rows], dv.VBD(h, 2), mu=mu[rows], lam=mu[rows])[0]
        return end, seen.alone[-1][:, 0]

    ends, alone = step(slice(None), SHORT)
    assert alone.tolist() == [True, False, False]
    for n in range(3):
        assert torch.equal(step([n], SHORT)[0][0], ends[n])
    assert not step(slice(None), 0.02)[1].any()
    # nothing is decided without a floor, nor where sweeps are too few
    for other, sweeps in ((dv.Model(MESHES["ball"], device=device), 2), (model, 1), (model, 0)):
        with Decisions() as seen:
            dv.step(other, x, v, dv.VBD(SHORT, sweeps), mu=1e5, lam=1e5)
        assert seen.alone[-1].numel() == 0


@pytest.mark.parametrize("sweeps", (2, 3))
@pytest.mark.parametrize("parts", (True, False))
def test_forward_and_gradients_are_those_of_the_twin(device: str, sweeps: int, parts: bool) -> None:
    """Two bodies in two scenes, of which one body flies; by every argument that a start knows."""
    mesh = dv.mesh.join([dv.mesh.cube(3, size=0.2), dv.mesh.cube(3, size=0.2).translate((0.5, 0.3, 0.0))])
    model, x, v = falling(mesh, device)
    x, v = held(model, x, v)
    noise = torch.from_numpy(generator("impact").uniform(-1, 1, (2, 2, *x.shape))).to(x)
    points = model.rest_points
    leaves: dict[str, Tensor] = {
        "x": x + 1e-6 * noise[0],
        "v": v + 0.2 * noise[1],
        "mu": torch.full((model.num_tets,), 1e5).to(x),
        "lam": torch.full((model.num_tets,), 2e5).to(x),
        "force": 300 * torch.sin(30 * points),
        "gravity": torch.tensor([0.5, -9.81, 1.0]).to(x),
        "rest_points": points.clone(),
        "density": torch.full((model.num_tets,), 1e3).to(x),
    }
    planes = {"kappa": KAPPA, "dhat": DHAT, "damping": 2.0, "height": [0.0], "normal": [[1e-5, 1.0, 2e-5]]}
    leaves |= {f"floor_{name}": torch.tensor(value).to(x) for name, value in planes.items()}
    solver = dv.VBD(SHORT if parts else 0.02, sweeps)

    def run(step: Any, on: dv.Model, rounded: float = 1.0) -> tuple[Tensor, dict[str, Tensor]]:
        given = {k: (rounded * t.detach().to(on.device)).requires_grad_() for k, t in leaves.items()}
        end, velocity = step(on, solver=solver, **given)
        loss = (torch.cos(3 * end) * end).sum() + (velocity * torch.sin(40 * end)).sum()
        bars = torch.autograd.grad(loss, list(given.values()))
        return end.detach().cpu(), {name: bar.cpu() for name, bar in zip(given, bars, strict=True)}

    with Decisions() as seen:
        end, bars = run(dv.step, model)
    assert seen.alone[-1].tolist() == [[parts, False]] * 2
    expected, twins = run(reference.step, model.to("cpu"))
    assert relative_error(end, expected) <= tolerance("forward")
    assert all(bool(twin.any()) for twin in twins.values())
    floors = dict.fromkeys(twins, tolerance("adjoint"))
    sample = lambda: errors_between(run(reference.step, model.to("cpu"), 1 + 2**-52)[1], twins)  # noqa: E731
    assert not beyond(errors_between(bars, twins), floors, [sample])


@pytest.mark.parametrize(
    ("mu", "sweeps", "h"), ((1e4, 2, 0.01), (1e5, 1, 0.01), (1e6, 2, 0.01), (2e6, 2, 1e-3), (2e6, 5, 3e-3))
)
def test_no_impact_gains_energy(device: str, mu: float, sweeps: int, h: float) -> None:
    """Of motion, gravity, tets and floor; the longer steps are those in which tets turn vertices back."""
    model, x, v = falling(dv.mesh.cube(6, size=0.2), device)
    plain = model.to("cpu")

    def energy() -> float:
        at = x.cpu()
        stored = reference.incremental_potential(plain, at, at, x_prev=at, mu=mu, lam=2 * mu, time_step=h) / h**2
        return float(stored) + float((model.mass * (v.square().sum(-1) / 2 + 9.81 * x[:, 1])).sum())

    first = energy()
    with torch.no_grad():
        for _ in range(20):
            x, v = dv.step(model, x, v, dv.VBD(h, sweeps), mu=mu, lam=2 * mu)
            assert energy() <= first * (1 + tolerance("energy_gain"))
