"""Claim: what the viewer shows follows from its arguments, without a browser: motions, colors, time, files, reruns;
what it cannot show is refused by name."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd import results
from diffvbd.viz import motion, values
from diffvbd.viz import viewer as clock
from diffvbd.viz.motion import scenery_of

MESH = dv.mesh.join([dv.mesh.cube(2, 0.2, split="kuhn"), dv.mesh.cube(2, 0.2, split="kuhn").translate((0.0, 0.5, 0.0))])
MODEL = dv.Model(MESH, energies=(dv.StableNeoHookean(), dv.FloorBarrier(-0.1)))
X = MODEL.rest_points
STEP = 0.01


def falling(steps: int = 6, scenes: int | None = None) -> results.Trajectory:
    x = X if scenes is None else X.expand(scenes, -1, -1).clone()
    return dv.rollout(MODEL, x, torch.zeros_like(x), dv.VBD(STEP, 3), steps=steps, mu=1e4, lam=1e4)


# --- motions ----------------------------------------------------------------------------------------------------------


def test_a_trajectory_has_its_frames_times_and_velocities() -> None:
    run = falling()
    (shown,) = motion.motions_of(run, MODEL, STEP).values()
    assert np.array_equal(shown.points, run.x.numpy()) and np.array_equal(shown.velocities, run.v.numpy())
    assert shown.times == pytest.approx(STEP * np.arange(7)) and len(shown) == 7
    assert np.array_equal(shown.triangles, MESH.surface) and np.array_equal(shown.body, MESH.body)


def test_scenes_and_names_are_motions_of_their_own() -> None:
    several = motion.motions_of(falling(scenes=2), MODEL, STEP)
    assert [*several] == ["scene 0", "scene 1"] and several["scene 1"].scene == 1
    assert np.array_equal(several["scene 1"].points, falling().x.numpy())
    named = motion.motions_of({"first": X, "second": falling().x}, MESH)
    assert [(name, len(each)) for name, each in named.items()] == [("first", 1), ("second", 7)]
    assert named["second"].times is None


@pytest.mark.parametrize(
    ("source", "mesh", "kind", "expected"),
    [
        (X[:, :2], MODEL, ValueError, r"source: expected shape \[16, 3\], \[N, 16, 3\] or .*, got shape \[16, 2\]"),
        (X.expand(2, 2, 2, -1, -1), MODEL, ValueError, "source: expected shape"),
        (X[None][:0], MODEL, ValueError, "source: expected at least one frame"),
        (X * float("nan"), MODEL, ValueError, "source: expected finite positions, got some .* frame 0"),
        (X, None, TypeError, "mesh: expected a dv.Model or a dv.TetMesh with Tensor, got None"),
        (X, MESH.points, TypeError, "mesh: expected a dv.Model or a dv.TetMesh, got ndarray"),
        (3.0, MODEL, TypeError, "source: expected a Trajectory, positions, a mesh or a file, got float"),
        ({}, MODEL, ValueError, "source: expected at least one motion"),
    ],
)
def test_what_is_no_motion_is_refused(source: Any, mesh: Any, kind: type, expected: str) -> None:
    with pytest.raises(kind, match=expected):
        motion.motions_of(source, mesh)


# --- colors -----------------------------------------------------------------------------------------------------------


def shown() -> motion.Motion:
    (found,) = motion.motions_of(falling(), MODEL, STEP).values()
    return found


def test_colors_are_the_quantities() -> None:
    moving, mu = shown(), np.linspace(1e4, 2e4, MESH.num_tets)
    known = values.Values(MODEL, mu, 1e4)
    speed = np.linalg.norm(moving.velocities, axis=-1)[:, MESH.surface].mean(-1)  # pyright: ignore
    assert known.values("speed", moving) == pytest.approx(speed)
    stress = dv.stress(MODEL, torch.from_numpy(moving.points), mu=torch.from_numpy(mu), lam=1e4).von_mises.numpy()
    assert known.values("stress", moving) == pytest.approx(stress[:, moving.tets])
    assert stress.max() > 0
    assert known.values("stiffness", moving) == pytest.approx(mu[moving.tets])
    low = motion.motions_of(X - torch.tensor([0.0, X[:, 1].min() + 0.09, 0.0]), MODEL)["motion"]
    force = dv.contact.forces(MODEL, torch.from_numpy(low.points[0])).vertices.total.norm(dim=-1).numpy()
    assert force.max() > 0
    assert known.values("contact", low)[0] == pytest.approx(force[MESH.surface].mean(-1))


def test_contact_force_follows_colliders_that_move() -> None:
    energies = (dv.StableNeoHookean(), dv.PairBarrier())
    model = dv.Model(MESH, energies=energies, colliders=[dv.colliders.Sphere((0.1, -1.0, 0.1), 0.1)])
    places = model.collider_points + torch.tensor([[[0.0, 0.0, 0.0]], [[0.0, 0.895, 0.0]]])
    (both,) = motion.motions_of(torch.stack([X, X]), model).values()
    force = values.Values(model, colliders=places).values("contact", both)
    assert force[0].max() == 0.0 < force[1].max()
    with pytest.raises(ValueError, match=r"colliders: expected 2 frames, got shape \[1, 1, 3\]"):
        values.Values(model, colliders=places[:1]).values("contact", both)


@pytest.mark.parametrize(
    ("color", "given", "expected"),
    [
        ("heat", {}, "color: expected one of body, speed, stress, stiffness, contact, got 'heat'"),
        ("speed", {}, r"color: speed \[m/s\] needs a time_step"),
        ("stress", {}, r"color: stress needs a dv.Model, or a mesh with mu and lam \[Pa\], got neither"),
        ("stress", {"model": MODEL, "mu": 1.0}, r"color: stress needs lam \[Pa\], got None"),
        ("stiffness", {"model": MODEL}, r"color: stiffness needs mu \[Pa\]"),
        ("stiffness", {"model": MODEL, "mu": float("nan")}, "mu: expected finite numbers, got nan"),
        ("stiffness", {"model": MODEL, "mu": np.ones(3)}, "mu: expected a number or one for each of 12 tets"),
        ("contact", {}, "color: contact needs a dv.Model"),
    ],
)
def test_colors_that_cannot_be_had_are_refused(color: str, given: dict, expected: str) -> None:
    (still,) = motion.motions_of(X, MESH).values()
    with pytest.raises(ValueError, match=expected):
        values.Values(**given).colors(color, still)


def test_floor_and_colliders_are_shown() -> None:
    ball = dv.colliders.Sphere((1.0, 0.0, 0.0), 0.2)
    wall = dv.colliders.Plane((0.0, 0.0, -1.0), (0.0, 0.0, 2.0))
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(-0.3), dv.PairBarrier())
    model = dv.Model(MESH, energies=energies, colliders=[ball, wall])
    low, high = MESH.points.min(0), MESH.points.max(0)
    floor, sphere, plane = scenery_of(model, low, high)
    assert floor.points[:, 1] == pytest.approx(-0.3) and plane.points[:, 2] == pytest.approx(-1.0)
    assert np.linalg.norm(sphere.points - [1.0, 0.0, 0.0], axis=1) == pytest.approx(0.2)
    moved = model.collider_points + torch.arange(3.0)[:, None, None]
    assert scenery_of(model, low, high, moved)[1].points.shape == (3, *sphere.points.shape)
    with pytest.raises(ValueError, match=r"colliders: expected shape \[N, 4, 3\], got shape \[3, 2, 3\]"):
        scenery_of(model, low, high, moved[:, :2])


# --- time -------------------------------------------------------------------------------------------------------------


def test_the_clock_plays_scrubs_loops_and_ends() -> None:
    ticking = clock.Clock(np.array([1.0, 1.1, 1.2, 1.3]), 4)
    assert ticking.advance(5.0) == 0  # it stands
    ticking.play()
    assert [ticking.advance(0.05) for _ in range(5)] == [0, 1, 1, 2, 2]
    ticking.speed = 4.0
    assert ticking.advance(0.05 / 4) == 3
    ticking.frame = 1
    assert ticking.frame == 1
    ticking.speed = 1.0
    assert ticking.advance(0.31) == 0  # 0.41 of a period of 0.4
    ticking.loop = False
    assert ticking.advance(9.0) == 3 and not ticking.playing
    ticking.play()
    assert ticking.frame == 0 and ticking.playing
    ticking.set_times(None, 2)
    assert ticking.end == 1 / clock.RATE


@pytest.fixture
def reruns() -> Iterator[Callable[..., clock.Rerun]]:
    made: list[clock.Rerun] = []

    def make(*arguments: Any, **options: Any) -> clock.Rerun:
        made.append(clock.Rerun(*arguments, **options))
        return made[-1]

    yield make
    for each in made:
        each.stop()


def until(true: Callable[[], bool]) -> bool:
    """Whether it becomes true, for as long as a busy machine may take."""
    end = time.monotonic() + 30.0
    while not true() and time.monotonic() < end:
        time.sleep(0.01)
    return true()


def test_a_slider_that_moves_reruns_once(reruns: Callable[..., clock.Rerun]) -> None:
    seen: list[Any] = []
    rerun = reruns(lambda mu: mu, seen.append, seen.append, delay=0.2)
    for mu in range(20):
        rerun.request(mu=mu)
    assert until(lambda: bool(seen)) and seen == [19] and rerun.runs == 1


def test_a_rerun_that_fails_is_told_and_the_next_one_runs(reruns: Callable[..., clock.Rerun]) -> None:
    seen: list[Any] = []
    rerun = reruns(lambda mu: 1 / mu, seen.append, lambda error: seen.append(type(error)), delay=0.0)
    rerun.request(mu=0)
    assert until(lambda: seen == [ZeroDivisionError])
    rerun.request(mu=2)
    assert until(lambda: seen[1:] == [0.5])


def test_what_is_asked_for_during_a_run_runs_after_it(reruns: Callable[..., clock.Rerun]) -> None:
    seen: list[int] = []
    begun, go = threading.Event(), threading.Event()

    def slow(mu: int) -> int:
        begun.set()
        assert go.wait(30.0)
        return mu

    rerun = reruns(slow, seen.append, print, delay=0.0)
    rerun.request(mu=1)
    assert begun.wait(30.0)
    rerun.request(mu=2)
    rerun.request(mu=3)
    go.set()
    assert until(lambda: len(seen) == 2) and seen == [1, 3]


# --- files ------------------------------------------------------------------------------------------------------------


def test_a_series_is_opened_as_it_was_written(tmp_path: Path) -> None:
    run, times = falling(), STEP * np.arange(7)
    dv.mesh.write_series(tmp_path / "part.pvd", MESH, run.x, times)
    found = motion.opened(tmp_path / "part.pvd")
    (moving,) = found.motions.values()
    assert moving.points == pytest.approx(run.x.numpy()) and moving.times == pytest.approx(times)
    assert found.mesh is not None and np.array_equal(found.mesh.body, MESH.body)
    single = motion.opened(tmp_path / "part_0003.vtu")
    assert next(iter(single.motions.values())).points[0] == pytest.approx(run.x[3].numpy())


@pytest.mark.parametrize(
    "log",
    ["[" * 10**5, '{"history": 3}', '{"history": [3]}', '{"history": [{"loss": "x"}]}'],
    ids=["nested too deep", "no rows", "no row", "no loss"],
)
def test_the_log_of_a_run_that_is_none_is_refused(log: str, tmp_path: Path) -> None:
    motion.save_motions(tmp_path / motion.MOTION, MESH.surface, {"target": X[None]}, STEP)
    (tmp_path / "log.json").write_text(log)
    with pytest.raises(ValueError, match="log.json: expected the log of a run, got"):
        motion.opened(tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "kind", "expected"),
    [
        ("none.pvd", None, FileNotFoundError, "none.pvd does not exist: expected a .pvd, a mesh"),
        ("bad.pvd", "no xml", ValueError, "bad.pvd: expected a .pvd collection"),
        ("empty.pvd", "<VTKFile><Collection/></VTKFile>", ValueError, "expected at least one frame"),
        ("lost.pvd", '<VTKFile><Collection><DataSet timestep="0" file="gone.vtu"/></Collection></VTKFile>',
         FileNotFoundError, "gone.vtu does not exist"),
        ("motion.npz", "no archive", ValueError, "expected motions of a run"),
        ("folder", "", ValueError, "expected the folder of a finished `diffvbd run` with motion.npz"),
        ("part.xyz", "?", ValueError, "part.xyz"),
    ],
)  # fmt: skip
def test_files_of_another_kind_are_refused(
    name: str, content: str | None, kind: type, expected: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif content is not None:
        path.write_text(content)
    with pytest.raises(kind, match=expected):
        motion.opened(path)
