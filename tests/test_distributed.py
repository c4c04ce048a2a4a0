"""Claim: scenes and bodies that ranks share have the bits that they have on one, gradients too, and a killed rank costs
nothing but time."""

import math
import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist
from helpers.paths import ROOT
from helpers.ranks import on_ranks
from helpers.task_checks import quick, timeless
from torch import Tensor, nn

import diffvbd as dv
from diffvbd import distributed
from diffvbd.cli import main
from diffvbd.tasks import Problem, Settings, solve
from diffvbd.tasks.million_cubes import QUICK, Cubes, is_near, launch_pad
from diffvbd.testing import relative_error, tolerance

ENVIRONMENT = {"TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}  # what docs/guides/scale-out.md tells users to set
SCENES, PARTS = 7, 3  # which two ranks cannot share evenly
KILL = """
import os, signal
from diffvbd import distributed
original = distributed.backward
calls = iter(range(100))
def backward(*arguments, **options):
    if next(calls) == 4 and os.environ.get("RANK") == "1" and not os.path.exists("killed"):
        open("killed", "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return original(*arguments, **options)
distributed.backward = backward
"""
ENDED = """
for thread in os.listdir("/proc/self/task"):  # one that outlives its group may abort the program as it ends
    assert "gloo" not in open(f"/proc/self/task/{thread}/comm").read()
"""


class Throw:
    """Cubes of which a network chooses the velocities, thrown at a plane."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.network = nn.Sequential(nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 3)).double()
        self.goals = torch.rand(SCENES, 3, dtype=torch.float64)
        plane = dv.colliders.Plane((0.0, -0.02, 0.0), (0.0, 1.0, 0.0))
        pairs = dv.PairBarrier(kappa=1e3, dhat=0.01, self_contact=False)
        self.model = dv.Model(dv.mesh.cube(2, size=0.1), energies=(dv.StableNeoHookean(), pairs), colliders=[plane])

    def loss(self, part: slice) -> Tensor:
        down = torch.tensor([0.0, -3.0, 0.0], dtype=torch.float64)  # which some parts detect more often
        v = (self.network(self.goals[part]) + self.goals[part, :1] * down)[:, None]
        v = v.expand(-1, self.model.num_vertices, -1)
        end = dv.rollout(self.model, self.model.rest_points.expand_as(v), v, dv.VBD(0.02, 5), steps=3, mu=1e4, lam=1e4,
                         save="last")  # fmt: skip
        return (end.x[-1].mean(-2) - self.goals[part]).square().sum() / SCENES


def train() -> dict[str, Any]:
    """Some steps of an optimiser by gradients of all parts."""
    throw = Throw()
    optimizer = torch.optim.Adam(throw.network.parameters(), 0.1)
    losses, gradients = [], []
    for _ in range(2):
        optimizer.zero_grad()
        losses.append(distributed.backward(throw.loss, throw.network.parameters(), SCENES, PARTS))
        gradients.append([p.grad for p in throw.network.parameters()])
        optimizer.step()
    return {"losses": losses, "gradients": gradients, "network": dict(throw.network.state_dict())}


def crowd(out: Path) -> tuple[Problem, Settings]:
    """Bodies that all fly towards the axis."""
    problem, settings = quick("million-cubes", out)
    with torch.no_grad():
        problem.parameters["velocity"].copy_(-5.0 * torch.from_numpy(launch_pad(64)))
    for stage in problem.stages:
        stage.iterations = 3
    return problem, settings


def push(out: Path) -> dict[str, Any]:
    """Loss and gradients of bodies that do not meet, and of bodies that do."""
    problem, _ = crowd(out)
    losses, gradients = [], []
    for stage in problem.stages:
        assert stage.before is not None
        stage.before(0)
        losses.append(loss := stage.loss())
        gradients.append(torch.autograd.grad(loss, list(problem.parameters.values())))
    return {"losses": [loss.detach() for loss in losses], "gradients": gradients}


def forces(out: Path) -> dict[str, Any]:
    """Forces and their gradient where bodies of other ranks are met, and where none is near; the error of a NaN."""
    cubes = Cubes(Settings(out, quick=True), QUICK)
    noise = torch.rand(cubes.target.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = cubes.own(noise.cos())[:, None]  # which a pull on each body has in what the gradient is of
    found = {"forces": [], "gradients": []}
    for scale in ((0.5, 0.5, 0.5), (1.0, 0.5, 1.0)):  # of the launch pad; its columns belong to ranks
        places = torch.from_numpy(launch_pad(64)) * torch.tensor(scale) + 2e-4 * noise
        x = cubes.own(places)[:, None].expand(-1, 8, -1).reshape(cubes.shape).requires_grad_()
        force = cubes.push(0, x, x)
        assert force is not None
        (gradient,) = torch.autograd.grad((force.view(-1, 8, 3) * weights).sum(), x)
        found["forces"].append(cubes.all_of(force.detach().view(-1, 8, 3)))
        found["gradients"].append(cubes.all_of(gradient.view(-1, 8, 3)))
        if dist.is_initialized():
            near = int(is_near(cubes.own(places), places).sum())
            assert near == cubes.bodies if scale[0] == 1 else near > cubes.bodies
            _check_room(cubes, places)
    broken = places.index_fill(0, torch.tensor([40]), math.nan)  # of one rank; all have to say so
    with pytest.raises(ValueError, match="expected finite values, got nan") as error:
        cubes.push(0, cubes.own(broken)[:, None].expand(-1, 8, -1).reshape(cubes.shape), x)
    return found | {"error": str(error.value)}


def _check_room(cubes: Cubes, places: Tensor) -> None:
    """In a CUDA graph bodies nearby have a fixed room, of which some may be left; where it is too small all is NaN, and
    the next graph has more."""
    near = is_near(cubes.own(places), places)
    whole, some = (places.clone().requires_grad_() for _ in range(2))
    rows, force = cubes.penalty_in_graph(whole, near)
    used = rows < len(places)
    assert torch.equal(rows[used], near.nonzero()[:, 0]) and not force[~used].any()
    alone = cubes.penalty(some[near])
    assert torch.equal(force[used], alone)
    gradients = [
        torch.autograd.grad((f * f.detach().sin()).sum(), leaf)[0] for f, leaf in ((force, whole), (alone, some))
    ]
    assert torch.equal(*gradients)
    cubes.room = int(near.sum()) - 1
    assert cubes.penalty_in_graph(whole, near)[1].isnan().all()
    cubes.captured, before = True, cubes.multiple
    x = cubes.own(places)[:, None].expand(-1, 8, -1).reshape(cubes.shape)
    cubes.push(0, x, x)  # outside of a graph
    assert cubes.room >= int(near.sum()) and cubes.multiple == 2 * before and not cubes.captured


def launch(out: Path) -> dict[str, Any]:
    """A run that is interrupted and goes on."""
    problem, settings = crowd(out)
    loss, calls = problem.stages[1].loss, iter(range(100))

    def failing() -> Tensor:
        if next(calls) == 2:
            raise KeyboardInterrupt
        return loss()

    problem.stages[1].loss = failing
    with pytest.raises(KeyboardInterrupt):
        solve(problem, settings)
    again, settings = crowd(out)
    history = timeless(solve(again, settings).history)
    return {"history": history, "parameters": {name: p.detach() for name, p in again.parameters.items()}}


def rows() -> dict[str, Any]:
    """Values and gradients through both changes of who has what."""
    given, shared = torch.arange(15.0).reshape(5, 3).requires_grad_(), torch.tensor(2.0, requires_grad=True)
    factor = distributed.own(shared.expand(5))[:, None]
    everything = distributed.gathered(factor * distributed.own(given) ** 2, 5)
    (weighted := everything * torch.arange(1.0, 6.0)[:, None]).sum().backward()
    assert shared.grad is not None and given.grad is not None
    assert shared.grad == (weighted / shared).sum() and torch.equal(given.grad[1:], (2 * weighted / given)[1:])
    return {"weighted": weighted.detach(), "gradient": given.grad}


def work(out: Path) -> dict[str, Any]:
    return {"rows": rows(), "train": train(), "push": push(out), "forces": forces(out)}


def by_ddp() -> list[Tensor]:
    throw = Throw()
    parallel = nn.parallel.DistributedDataParallel(throw.network)
    throw.network = parallel  # pyright: ignore[reportAttributeAccessIssue]
    (throw.loss(distributed.share(SCENES)) * dist.get_world_size()).backward()
    return [p.grad for p in parallel.parameters() if p.grad is not None]


def leaves(value: Any) -> list[Any]:
    """Tensors as lists of numbers, out of whatever holds them."""
    if isinstance(value, dict):
        value = [value[key] for key in sorted(value)]
    if isinstance(value, (list, tuple)):
        return [leaf for child in value for leaf in leaves(child)]
    return [value.tolist() if isinstance(value, Tensor) else value]


def check_not_zero(found: dict[str, Any]) -> None:
    gradients = [*found["train"]["gradients"], *found["push"]["gradients"]]
    assert all(gradient.any() for group in gradients for gradient in group) and found["rows"]["gradient"][1:].all()
    free, pushed = found["push"]["gradients"]
    assert (free[0] - pushed[0]).abs().max() > 0.01 * free[0].abs().max()
    assert found["train"]["losses"][1] < found["train"]["losses"][0]
    for values in (found["forces"]["forces"], found["forces"]["gradients"]):
        # of bodies that meet no others both sum to zero: the first 32 meet the others only where all are close
        close, columns = ((value[:32].sum((0, 1)).norm() / value.norm()).item() for value in values)
        assert close > 0.1 and columns < tolerance("cancelling") and all(value.any((1, 2)).all() for value in values)
    assert "at [0, 40, 0]" in found["forces"]["error"]


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [2, 3])
def test_ranks_have_the_bits_of_one(ranks: int, tmp_path: Path) -> None:
    alone = work(tmp_path)
    check_not_zero(alone)
    for found in on_ranks(work, ranks, tmp_path / "ranks", tmp_path):
        assert leaves(found) == leaves(alone)


@pytest.mark.slow
def test_a_run_over_ranks_goes_on_and_its_first_rank_alone_writes(tmp_path: Path) -> None:
    alone = launch(tmp_path / "alone")
    assert len(alone["history"]) == 6
    for found in on_ranks(launch, 2, tmp_path / "ranks", tmp_path / "together"):
        assert leaves(found) == leaves(alone)
    assert {path.name for path in (tmp_path / "together").iterdir()} == {"log.json", "motion.npz"}
    whole, gathered = (np.load(tmp_path / name / "motion.npz") for name in ("alone", "together"))
    assert whole.files == gathered.files and all(np.array_equal(whole[key], gathered[key]) for key in whole.files)


@pytest.mark.slow
def test_the_gradient_is_that_of_distributed_data_parallel(tmp_path: Path) -> None:
    throw = Throw()
    distributed.backward(throw.loss, throw.network.parameters(), SCENES, PARTS)
    for found in on_ranks(by_ddp, 2, tmp_path / "ranks"):
        for gradient, parameter in zip(found, throw.network.parameters(), strict=True):
            assert parameter.grad is not None and parameter.grad.any()
            assert relative_error(gradient, parameter.grad) <= tolerance("adjoint")


def script() -> str:
    """The program of docs/guides/scale-out.md that users are told to save."""
    (first, *_) = re.findall(
        r"^```python\n(.*?)^```$", (ROOT / "docs" / "guides" / "scale-out.md").read_text(), re.M | re.S
    )
    return first


def run(folder: Path, text: str, *launcher: str) -> dict[str, Tensor]:
    """Runs a program in a folder; the network that it leaves."""
    folder.mkdir()
    (folder / "train.py").write_text(text)
    command = [sys.executable, *launcher, "train.py"]
    done = subprocess.run(
        command, cwd=folder, env=os.environ | ENVIRONMENT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return torch.load(folder / "state.pt")["network"]


@pytest.mark.slow
def test_a_killed_rank_changes_no_bit_of_the_result(tmp_path: Path) -> None:
    """The program of the docs, on one process, and on two of which torchrun starts anew what was killed."""
    whole = run(tmp_path / "whole", script())
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "--max-restarts", "1")
    parts = run(tmp_path / "parts", KILL + script() + ENDED, *torchrun)
    assert (tmp_path / "parts" / "killed").exists() and not (tmp_path / "whole" / "killed").exists()
    assert leaves(parts) == leaves(whole)


@pytest.mark.parametrize(("count", "ranks"), [(2, 2), (7, 3), (1000, 7)])
def test_shares_are_even_and_leave_nothing_out(count: int, ranks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed, "_ranks", lambda: ranks)
    found = []
    for rank in range(ranks):
        monkeypatch.setattr(distributed, "_rank", lambda rank=rank: rank)
        found.append(distributed.share(count))
    assert (found[0].start, found[-1].stop) == (0, count) and all(a.stop == b.start for a, b in pairwise(found))
    assert {s.stop - s.start for s in found} <= {count // ranks, -(-count // ranks)}
    with pytest.raises(ValueError, match=f"count: expected at least one row for each of {ranks} ranks"):
        distributed.share(ranks - 1)


def test_what_ranks_cannot_share_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                             capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    monkeypatch.setenv("WORLD_SIZE", "2")
    for task, device, message in (
        ("beam-mu", "cpu", "torchrun: expected a task that ranks can share"),
        ("million-cubes", "cuda:1", "device: expected cuda, of which each rank takes its own, got cuda:1"),
    ):
        assert main(["run", task, "--quick", "--device", device, "--out", str(tmp_path)]) == 2
        assert message in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_bad_input_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    leaf = torch.ones(2, requires_grad=True)
    other = torch.ones(2, requires_grad=True)

    def loss(part: slice) -> Tensor:
        return leaf.sum()

    with pytest.raises(TypeError, match="parameters: expected leaf tensors"):
        distributed.backward(loss, [leaf * 2], 4, 2)
    with pytest.raises(ValueError, match="parts: expected from 1, .* to 4, .*got 5"):
        distributed.backward(loss, [leaf], 4, 5)
    with pytest.raises(ValueError, match="loss: expected a scalar tensor, got shape"):
        distributed.backward(lambda part: leaf, [leaf], 4, 2)
    with pytest.raises(ValueError, match=r"does not depend on parameters \[1\]"):
        distributed.backward(loss, [leaf, other], 4, 2)
    with pytest.raises(ValueError, match=r"values: expected 3 rows, this rank's of 3, got shape \[2\]"):
        distributed.gathered(leaf, 3)
    with pytest.raises(TypeError, match="values: expected a tensor, got list"):
        distributed.own([1.0])  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(distributed, "_ranks", lambda: 4)
    with pytest.raises(ValueError, match="parts: expected from 4, one for each rank"):
        distributed.backward(loss, [leaf], 4, 2)


def test_gradients_add_to_what_is_there() -> None:
    leaf = torch.ones(2, requires_grad=True)

    def loss(part: slice) -> Tensor:
        return (part.stop - part.start) * leaf.square().sum()

    assert [distributed.backward(loss, [leaf], 10, 4).item() for _ in range(2)] == [20.0, 20.0]
    assert leaf.grad is not None and leaf.grad.tolist() == [40.0, 40.0]
