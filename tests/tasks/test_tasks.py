"""The shipped inverse problems find what they look for, with the gradient they claim, and survive an interruption."""

import importlib.util
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.marks import quick_and_slow, slow
from helpers.task_checks import check_fall, check_gradient, quick, timeless

import diffvbd as dv
from diffvbd import losses
from diffvbd.tasks import TASKS, Settings, beam, fit_real_mesh, million_cubes, solve, table
from diffvbd.tasks.cloth import TRUE_WIND, cut, reference_wind
from diffvbd.tasks.cover_the_spot import faces_up, outline, smooth_uncovered, sunflower, uncovered
from diffvbd.tasks.dress import SOFTNESS, profile
from diffvbd.tasks.fit_real_mesh import HEIGHT, scaled
from diffvbd.tasks.learn_controller import cma_es
from diffvbd.tasks.million_cubes import RADIUS, is_near
from diffvbd.tasks.throw import inside
from diffvbd.testing import tolerance

MATERIAL = sorted(name for name in TASKS if name.startswith("beam"))


@pytest.mark.parametrize("name", quick_and_slow(MATERIAL[:1], MATERIAL))
def test_quick_run_recovers_the_material(name: str, tmp_path: Path) -> None:
    problem, settings = quick(name, tmp_path)
    result = solve(problem, settings)
    start = result.history[0]
    assert result.best["loss"] < tolerance("quick_fall") * result.history[0]["loss"]
    for quantity, error in result.errors.items():
        assert error < 0.02 < abs(start[quantity] / problem.truth[quantity] - 1)
    assert f"{result.estimates['mu']:.6g}" in table(problem, result)


# Task, stage, step of the differences, tolerance. Truncation falls with the square of the step, rounding grows with its
# inverse. Limits, shares and nearest features have kinks: a very short step meets none, a longer one steps over some.
GRADIENTS = [
    *((name, 0, 1e-5, "finite_difference") for name in MATERIAL),
    *((name, 0, 1e-5, "finite_difference") for name in ("cape-mu", "cape-wind", "dress-size", "flag-wind")),
    *((name, 0, 1e-6, "long_difference") for name in ("cube-bounce", "bunny-bounce", "learn-controller")),
    *((name, k, 1e-6, "kinked_difference") for name in ("dress-mu-lam", "dress-silhouette") for k in range(3)),
    *(("fit-real-mesh", k, 1e-5, "long_difference") for k in range(2)),
    *(("million-cubes", k, 1e-4, "coarse_difference") for k in range(2)),  # tiny against that of the velocity
    ("cover-the-spot", 0, 1e-8, "kinked_difference"),
    ("throw", 0, 1e-6, "kinked_difference"),
    ("lift", 0, 1e-6, "kinked_difference"),
]


@pytest.mark.parametrize(("name", "stage", "step", "rel"), GRADIENTS)
def test_gradient_is_that_of_central_differences(name: str, stage: int, step: float, rel: str, tmp_path: Path) -> None:
    check_gradient(name, tmp_path, step=step, rel=tolerance(rel), stage=stage)


@pytest.mark.slow
def test_log_and_picture_are_written(tmp_path: Path) -> None:
    settings = Settings(tmp_path, quick=True)
    result = solve(beam.beam_mu(settings), settings)
    log = json.loads((tmp_path / "log.json").read_text())
    assert {"diffvbd", "torch", "numpy", "python"} <= set(log["versions"])
    assert log["settings"]["seed"] == 0
    assert log["history"] == result.history
    assert set(log["history"][0]) == {"iteration", "loss", "gradient_norm", "mu", "seconds"}
    assert log["best"]["loss"] == min(row["loss"] for row in log["history"])
    if pytest.importorskip("matplotlib"):
        assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "state.pt").exists()


class Interrupted(Exception):
    pass


@pytest.mark.slow
def test_an_interrupted_run_continues_with_the_same_numbers(tmp_path: Path) -> None:
    problem, settings = quick("beam-mu", tmp_path / "whole")
    whole = solve(problem, settings)

    problem, settings = quick("beam-mu", tmp_path / "parts")
    loss, evaluations = problem.stages[0].loss, 0

    def failing() -> torch.Tensor:
        nonlocal evaluations
        evaluations += 1
        if evaluations == 8:
            raise Interrupted
        return loss()

    problem.stages[0].loss = failing
    with pytest.raises(Interrupted):
        solve(problem, settings)
    problem, settings = quick("beam-mu", tmp_path / "parts")
    parts = solve(problem, settings)
    assert timeless(parts.history) == timeless(whole.history)


def test_a_state_of_other_settings_is_not_continued(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    problem, settings = quick("beam-mu", tmp_path)
    loss, evaluations = problem.stages[0].loss, iter(range(3))
    problem.stages[0].loss = lambda: (next(evaluations), loss())[1]
    with pytest.raises(StopIteration):
        solve(problem, settings)
    problem, _ = quick("beam-mu", tmp_path)
    problem.stages[0].iterations = 2
    assert len(solve(problem, Settings(tmp_path, seed=1, quick=True)).history) == 2
    assert "starting anew" in capsys.readouterr().err


def test_a_loss_that_is_not_finite_is_reported(tmp_path: Path) -> None:
    problem, settings = quick("beam-mu", tmp_path)
    (parameter,) = problem.parameters.values()
    problem.stages[0].loss = lambda: parameter * float("nan")
    with pytest.raises(ArithmeticError, match="beam-mu: the loss or its gradient is not finite"):
        solve(problem, settings)


@pytest.mark.parametrize(
    ("loss", "kind", "says"),
    [
        (lambda x: losses.huber(x, x[:3], 0.1), ValueError, r"target: .* broadcasts to \[4, 3\], got \[3, 3\]"),
        (lambda x: losses.huber(x[:1], x, 0.1), ValueError, r"target: .* broadcasts to \[1, 3\], got \[4, 3\]"),
        (lambda x: losses.huber(x, x, "far"), TypeError, "delta: expected a number, got str"),
        (lambda x: losses.vertex_distance(x, x.numpy()), TypeError, "target: expected a tensor, got ndarray"),
        (lambda x: losses.vertex_distance([0.0], x), TypeError, "x: expected a tensor, got list"),
        (lambda x: losses.center_of_mass(x, torch.ones(3)), ValueError, r"mass: expected shape \[4\], .* shape \[3\]"),
        (lambda x: losses.center_of_mass(x, torch.ones(1)), ValueError, r"mass: expected shape \[4\], .* shape \[1\]"),
        (lambda x: losses.center_of_mass(x, np.ones(4)), TypeError, "mass: expected a tensor, got ndarray"),
    ],
)
def test_losses_name_what_does_not_fit(loss: Callable[[torch.Tensor], object], kind: type, says: str) -> None:
    with pytest.raises(kind, match=says):
        loss(torch.zeros(4, 3))


@pytest.mark.cuda
@pytest.mark.parametrize("name", sorted(TASKS))
def test_captured_run_has_the_numbers_of_an_eager_one(name: str, tmp_path: Path) -> None:
    histories = []
    for capturable in (True, False):
        settings = Settings(tmp_path / str(capturable), device="cuda", quick=True)
        problem = TASKS[name].build(settings)
        problem.picture = None
        for stage in problem.stages:
            stage.iterations = min(stage.iterations, 4)
            assert stage.capturable
            stage.capturable = capturable
        histories.append(timeless(solve(problem, settings).history))
    assert histories[0] == histories[1]
    assert histories[0][0]["loss"] != histories[0][3]["loss"] != 0.0


# --- bounces ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cube-bounce", slow("bunny-bounce")])
def test_quick_run_comes_close_after_the_bounce(name: str, tmp_path: Path) -> None:
    result = check_fall(name, tmp_path, factor=0.02)
    # of a motion of this size
    assert result.estimates["distance"] < 0.034 < 0.29 < result.history[0]["distance"]
    assert result.estimates["distance"] ** 2 == pytest.approx(result.best["loss"], rel=tolerance("cancelling"))
    found = result.findings
    assert found["start_distance"] == result.history[0]["distance"]
    assert 0 < found["first_contact"] < found["closest_approach"] and found["envelope"] > 0.5


# --- cloth ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "factor"), [("cape-mu", 1e-4), slow("dress-size", 1e-4)])
def test_quick_run_recovers_the_truth(name: str, factor: float, tmp_path: Path) -> None:
    result = check_fall(name, tmp_path, factor)
    (error,) = result.errors.values()
    assert error < tolerance("recovered_cloth")


def test_quick_run_recovers_the_wind_of_a_cape(tmp_path: Path) -> None:
    result = check_fall("cape-wind", tmp_path, 1e-5)
    assert set(result.errors) == {"wind_x", "wind_z"}
    assert max(result.errors.values()) < tolerance("recovered_wind")
    assert abs(result.estimates["wind_y"]) < tolerance("recovered_wind") * math.hypot(*TRUE_WIND)
    assert result.history[0]["deviation"] == 1.0
    assert result.estimates["deviation"] < tolerance("recovered_wind")


def test_singular_values_are_those_of_the_loss(tmp_path: Path) -> None:
    problem, _ = quick("flag-wind", tmp_path)
    (stage,), wind = problem.stages, problem.parameters["wind"]
    assert problem.findings is not None
    with torch.no_grad():
        wind.copy_(reference_wind())
    values = problem.findings([])["singular_values"]
    assert problem.stages[0].loss().item() == 0.0
    # squared and summed over all directions: the trace of the loss's quadratic form
    trace, step = 0.0, 1e-3
    for k in range(wind.numel()):
        with torch.no_grad():
            wind.copy_(reference_wind())
            wind.view(-1)[k] += step
            trace += stage.loss().item() / step**2
    assert sum(value**2 for value in values) == pytest.approx(trace, rel=tolerance("one_sided_difference"))


@pytest.mark.parametrize("size", [0.45, 0.91, 1.3])
def test_cut_is_the_dress_of_that_size_in_the_same_cloth(size: float) -> None:
    one = dv.mesh.dress(8, 6, 0.01, neck_height=1.45, hem_height=0.65)
    other = dv.mesh.dress(8, 6, 0.01, neck_height=1.45, hem_height=1.45 - 0.8 * size, scale=size)
    neck = torch.tensor([0.0, 1.45, 0.0], dtype=torch.float64)
    points = cut(torch.tensor(one.points), torch.tensor(size, dtype=torch.float64), neck)
    torch.testing.assert_close(points, torch.tensor(other.points), rtol=0.0, atol=tolerance("geometry"))


# --- a beam that is lifted --------------------------------------------------------------------------------------------


def test_quick_run_lifts_what_lay_on_the_ground(tmp_path: Path) -> None:
    pytest.importorskip("yourdfpy")
    result = check_fall("lift", tmp_path, factor=0.1, iterations=6)
    found = result.findings
    squeezes = [found[f"{name}_squeeze"] / found["slip_limit"] for name in ("initial", "recovered")]
    assert squeezes[0] < 0.5 and 0.95 < squeezes[1] < 2
    assert found["initial_rise"] < 0.001 and found["recovered_rise"] > 0.02


# --- disks that cover a target ----------------------------------------------------------------------------------------


DISK = dv.mesh.disk(0.42, 0.06, 6)


@pytest.mark.slow
def test_quick_run_covers_more(tmp_path: Path) -> None:
    result = check_fall("cover-the-spot", tmp_path, factor=0.7, iterations=5)
    assert result.history[0]["uncovered"] > 0.2
    assert result.estimates["uncovered"] < 0.7 * result.history[0]["uncovered"]
    assert result.estimates["uncovered"] == min(row["uncovered"] for row in result.history)


def test_smooth_share_tends_to_the_share_and_pulls_disks_in() -> None:
    points = sunflower(2000, 0.45)
    rest = torch.tensor(DISK.points)
    rim, faces = torch.tensor(outline(DISK)), torch.tensor(faces_up(DISK))
    offsets = torch.tensor([[0.5, 0.0, 0.0], [-0.3, 0.0, 0.4], [-0.2, 0.0, -0.5]], dtype=torch.float64)
    offsets.requires_grad_()
    disks = rest + offsets[:, None]
    sharp = smooth_uncovered(disks[:, rim], points, torch.tensor(1e4)).item()
    assert sharp == pytest.approx(uncovered(disks[:, faces], points).item(), abs=tolerance("sampled_area"))
    turned = smooth_uncovered(disks[:, rim].flip(1), points, torch.tensor(1e4)).item()  # upside down
    assert turned == pytest.approx(sharp, rel=tolerance("adjoint"))
    smooth_uncovered(disks[:, rim], points, torch.tensor(10.0)).backward()
    assert (offsets.grad * offsets.detach()).sum(1).min().item() > 0.0
    assert offsets.grad[:, 1].abs().max().item() == 0.0


# --- drape of a dress -------------------------------------------------------------------------------------------------


HEIGHTS = torch.tensor([0.1, 0.4, 0.7], dtype=torch.float64)


@pytest.mark.parametrize("name", [slow("dress-mu-lam"), slow("dress-silhouette")])
def test_quick_run_recovers_the_material_dress(name: str, tmp_path: Path) -> None:
    result = check_fall(name, tmp_path, factor=1e-3, whole=True)
    # what the alternation adds to stage A
    entered = next(row for row in result.history if row["stage"] == 1)
    assert max(result.errors.values()) < tolerance("recovered_dress") < 0.01 < abs(entered["lam"] / 800 - 1)


def around(radius: torch.Tensor, heights: torch.Tensor, turn: float = 0.0) -> torch.Tensor:
    """Rings of 12 points about the y axis, of a radius at each height."""
    angle = turn + 2 * torch.pi * torch.arange(12, dtype=torch.float64) / 12
    ring = torch.stack([angle.cos(), torch.zeros_like(angle), angle.sin()], -1)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return (radius[:, None, None] * ring + heights[:, None, None] * up).reshape(-1, 3)


def test_profile_is_the_radius_of_the_outline_and_forgets_which_vertex_is_where() -> None:
    radius = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    outline = around(radius, HEIGHTS)
    torch.testing.assert_close(profile(outline, HEIGHTS), radius, rtol=0, atol=tolerance("softened"))
    # an inner layer hides behind the outer one, up to exp(-distance / SOFTNESS) of its distance
    inner = around(radius - 0.05, HEIGHTS)
    both = torch.cat([inner, outline])
    expected = radius - 0.05 / (1 + torch.tensor(0.05 / SOFTNESS).exp())
    torch.testing.assert_close(profile(both, HEIGHTS), expected, rtol=0, atol=tolerance("softened"))
    order = torch.randperm(len(both), generator=torch.Generator().manual_seed(0))
    frames = torch.stack([both[order], torch.cat([around(radius - 0.05, HEIGHTS, 0.3), around(radius, HEIGHTS, 0.7)])])
    torch.testing.assert_close(profile(frames, HEIGHTS), expected.expand(2, 3), rtol=0, atol=tolerance("softened"))


# --- stiffness of a scanned body --------------------------------------------------------------------------------------


BODY = scaled(dv.mesh.bunny(8), HEIGHT)


@pytest.mark.slow
def test_quick_run_finds_both_regions(tmp_path: Path) -> None:
    result = check_fall("fit-real-mesh", tmp_path, factor=0.08)
    uniform = [row for row in result.history if row["stage"] == 0]
    assert min(row["field_error"] for row in uniform) > 0.5
    assert result.errors["mu_soft"] < 0.08 and result.errors["mu_stiff"] < 0.15
    assert result.estimates["field_error"] < 0.1
    assert 0.9 < result.findings["misfit_of_truth"] < result.findings["misfit"] < 2.0


@pytest.mark.slow
def test_weight_falls_until_the_misfit_is_that_of_the_noise(tmp_path: Path) -> None:
    # this seed's noise is a little smaller than stated
    problem = fit_real_mesh.problem(Settings(tmp_path, seed=2))
    exponents, lowered = problem.parameters["exponents"], problem.state["lowered"]

    def enter(stage: int) -> None:
        before = problem.stages[stage].before
        assert before is not None
        before(0)
        before(0)  # a captured stage asks twice
        before(1)

    enter(1)
    enter(2)
    body = scaled(dv.mesh.bunny(10), HEIGHT)
    middle = 0.5 * (body.points.min(0) + body.points.max(0))
    stiff = (body.points[body.tets].mean(1) - middle)[:, :2].sum(1) > 0
    with torch.no_grad():
        true = torch.from_numpy(np.where(stiff, 2e4, 5e3) / fit_real_mesh.START).log()
        limit = math.log(fit_real_mesh.RANGE)
        exponents.copy_(limit * (true / limit).atanh())
    assert problem.estimates()["within_10_percent"] == 1.0
    enter(3)
    assert problem.findings is not None
    assert problem.findings([])["weight"] == pytest.approx(100.0 / math.sqrt(10))
    assert lowered.tolist() == [0, 0, 1, 0, 0]


def test_mesh_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "big.mesh"
    dv.mesh.save(file, BODY.transform(7.0 * np.eye(3)).translate([1.0, 2.0, 3.0]))
    problem = fit_real_mesh.problem(Settings(tmp_path, quick=True), mesh=file, iterations=7)
    assert [stage.iterations for stage in problem.stages] == [5, 7]
    assert problem.protocol["tets"] == BODY.num_tets
    assert scaled(dv.mesh.load(file), HEIGHT).points[:, 1] == pytest.approx(BODY.points[:, 1])
    with pytest.raises(FileNotFoundError, match="none.mesh"):
        fit_real_mesh.problem(Settings(tmp_path), mesh=tmp_path / "none.mesh")
    surface = tmp_path / "surface.obj"
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in np.vstack([np.zeros(3), np.eye(3)]))
    surface.write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    with pytest.raises(ValueError, match="edge_length: expected"):
        fit_real_mesh.problem(Settings(tmp_path), mesh=surface, edge_length=-1.0)
    with pytest.raises(ValueError, match="iterations: expected at least 1, got 0"):
        fit_real_mesh.problem(Settings(tmp_path), iterations=0)
    if importlib.util.find_spec("pytetwild") is None:
        with pytest.raises(ImportError, match="pytetwild"):
            fit_real_mesh.problem(Settings(tmp_path), mesh=surface)


# --- controllers ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_quick_run_learns(tmp_path: Path) -> None:
    result = check_fall("learn-controller", tmp_path, factor=0.1)
    assert result.history[0]["distance"] > 0.2
    assert result.findings["test"]["distance"] < result.history[0]["distance"]


def test_cma_es_lowers_a_loss_without_its_gradient() -> None:
    pytest.importorskip("cma")
    goal = torch.linspace(-1, 1, 5, dtype=torch.float64)

    def losses(rows: torch.Tensor) -> torch.Tensor:
        return (rows - goal).square().sum(-1)

    best, course, count = cma_es(losses, torch.zeros(5, dtype=torch.float64), 0.2, seed=0)
    assert losses(best[None]).item() == course[-1][1] < 0.1 * course[0][1]
    assert course[-1][0] >= 0.2
    assert count % len(course) == 0
    assert all(a[0] < b[0] and a[1] >= b[1] for a, b in zip(course, course[1:], strict=False))
    _, course, _ = cma_es(losses, torch.zeros(5, dtype=torch.float64), 0.0, seed=0)
    assert len(course) == 1


# --- very many bodies -------------------------------------------------------------------------------------------------


NAME = "million-cubes"


@pytest.mark.slow
def test_quick_run_brings_bodies_to_their_places(tmp_path: Path) -> None:
    result = check_fall(NAME, tmp_path, factor=0.9)
    errors = [row["mean_error"] for row in result.history]
    assert errors[0] > 0.03 and result.estimates["mean_error"] < 0.03 * errors[0]
    assert result.findings["mean_error_with_contact"] == result.estimates["mean_error"]


@pytest.mark.slow
def test_an_interrupted_run_continues_in_the_second_stage(tmp_path: Path) -> None:
    def run(folder: Path, fail_at: int | None) -> list[dict[str, float]]:
        problem, settings = quick(NAME, folder)
        for stage in problem.stages:
            stage.iterations = 4
        loss, calls = problem.stages[1].loss, iter(range(100))

        def failing() -> torch.Tensor:
            if next(calls) == fail_at:
                raise KeyboardInterrupt
            return loss()

        problem.stages[1].loss = failing
        return timeless(solve(problem, settings).history)

    whole = run(tmp_path / "whole", None)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", 2)
    assert run(tmp_path / "parts", None) == whole


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("away", [0.0, 1e3])
def test_bodies_near_others_leave_out_no_pair(away: float, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    points = (away + 0.03 * torch.rand(2000, 3, generator=generator, dtype=torch.float64)).to(dtype)
    some = points[points[:, 0] < away + 0.01]
    near = is_near(some, points)
    pair = (points[:, None] - some).square().sum(-1) < RADIUS**2
    assert bool((near | ~pair.any(1)).all()) and len(some) < int(near.sum()) < 0.7 * len(points)
    for broken in (torch.nan, torch.inf):
        points[-1, 1] = broken
        assert bool(is_near(some, points).all())


def test_bad_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bodies: expected at least 1, got 0"):
        million_cubes.problem(Settings(tmp_path), bodies=0)
    for wrong in ({"bodies": 65}, {"steps": 240}):
        with pytest.raises(ValueError, match="at most 64|none with --quick"):
            quick(NAME, tmp_path, **wrong)
    with pytest.raises(ValueError, match="steps: expected at least 120, .* got 119"):
        million_cubes.problem(Settings(tmp_path), bodies=4, steps=119)
    with pytest.raises(ValueError, match="iterations: expected at least 1, got 0"):
        million_cubes.problem(Settings(tmp_path), bodies=4, iterations=0)


# --- throws -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_quick_run_throws_closer(tmp_path: Path) -> None:
    result = check_fall("throw", tmp_path, factor=0.2)
    assert result.history[0]["miss"] > 0.5
    assert result.estimates["miss"] < 0.5 * result.history[0]["miss"]


def test_inside_wants_every_point() -> None:
    box = ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    points = torch.tensor([[0.5, 1.9, 2.9], [0.1, 0.1, 0.1]])
    assert inside(points, box)
    for axis, beyond in ((0, 1.1), (1, 2.1), (2, -0.1)):
        moved = points.clone()
        moved[1, axis] = beyond
        assert not inside(moved, box)
