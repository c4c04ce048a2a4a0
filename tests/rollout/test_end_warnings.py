"""Claim: a rollout, or a step of a loop, that ends with what is no number or too far away says so, each time, and what
is at fault; so does one whose sweeps leave its motion wrong, and one that bends tets too thin for it."""

import warnings
from typing import Any

import pytest
import torch
from helpers.two_boxes import two_boxes
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.mesh import box
from diffvbd.model.system import system_of
from diffvbd.rollout import checks
from diffvbd.step.arguments import material_of, prepare
from diffvbd.step.contact import TRUNCATED
from diffvbd.step.residual import truncated_fraction
from diffvbd.step.warnings import FAR
from diffvbd.testing import tolerance

MEASURES_GROWTH = True  # see conftest.py

SOFT: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "solver": dv.VBD(0.01, 10)}


def bent(**options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    """A bar whose velocities bend it."""
    model = dv.Model(dv.mesh.box((5, 2, 2), (0.4, 0.1, 0.1)), **options)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = 20 * x[:, 0].square()
    return model, x, v


def messages(run: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        run()
    return [str(w.message) for w in found]


# --- what is no number, or far away -----------------------------------------------------------------------------------


def lost() -> tuple[dv.Model, Tensor, Tensor]:
    """A state so stretched that a step in single precision has no number for it."""
    model, x, v = bent(dtype=torch.float32)
    return model, 1e20 * x, v


def test_an_end_that_is_no_number_is_warned_of() -> None:
    model, x, v = lost()
    for _ in range(2):  # each time
        with pytest.warns(UserWarning, match="x: the rollout ended with positions or velocities that are not") as found:
            end = dv.rollout(model, x, v, steps=1, save="last", **SOFT)
        assert not bool(torch.isfinite(end.x).all())
        assert found[0].filename == __file__
    with pytest.raises(ValueError, match="expected finite values"):
        dv.rollout(model, x, v, steps=2, **SOFT)
    assert messages(lambda: dv.rollout(model, 1e-20 * x, v, steps=1, **SOFT)) == []


@pytest.mark.cuda
def test_the_next_rollout_says_it_on_cuda() -> None:
    model, x, v = lost()
    model, x, v = model.to("cuda"), x.cuda(), v.cuda()
    assert messages(lambda: dv.rollout(model, x, v, steps=2, **SOFT)) == []
    torch.cuda.synchronize()
    with pytest.warns(UserWarning, match="before this one ended"):
        dv.rollout(model, 1e-20 * x, v, steps=1, **SOFT)
    torch.cuda.synchronize()
    assert messages(lambda: dv.rollout(model, 1e-20 * x, v, steps=1, **SOFT)) == []


def driven(force: Any, steps: int = 30) -> list[str]:
    model, x, v = bent()
    return messages(lambda: dv.rollout(model, x, 0 * v, steps=steps, force=force, gravity=(0.0, -1.0, 0.0), **SOFT))


def test_a_force_that_explodes_is_blamed() -> None:
    """An explicit drag of 50 N s/m: each step turns velocities round and makes more of them."""
    for _ in range(2):  # each time
        (text,) = driven(lambda k, x, v: -50.0 * v, steps=20)
        assert f"more than {FAR:g} body sizes" in text and "force: in one step it changes velocities by more" in text
    with pytest.raises(
        ValueError, match=r"expected finite values.*\(in step \d+\), which the steps before made; force:"
    ):
        driven(lambda k, x, v: -50.0 * v, steps=200)
    with pytest.raises(ValueError, match=r"force: expected finite values, got nan .*\(in step 3\)"):
        driven(lambda k, x, v: torch.full_like(x, torch.nan) if k == 3 else 0 * x)
    assert driven(lambda k, x, v: -0.5 * v) == []


def test_sweeps_and_time_steps_are_blamed() -> None:
    model = dv.Model(dv.mesh.beam(7, 2, 2, size=(0.6, 0.1, 0.1)))
    x, v = model.rest_points, 0 * model.rest_points
    v[:, 1] = torch.sin(9 * x[:, 0])
    said = messages(lambda: dv.rollout(model, x, v, dv.VBD(0.01, 2, integrator=dv.SDIRK2(), relaxation=1.7), steps=16,
                                       mu=1e8, lam=4e8, gravity=(0.0, 0.0, 0.0)))  # fmt: skip
    assert any("more than 1000 body sizes" in text and "sweeps: so few let vibrations grow" in text for text in said)


def test_a_flight_is_not_lost() -> None:
    model, x, v = bent()
    flight: dict[str, Any] = {"mu": 10.0, "lam": 10.0, "solver": dv.VBD(0.9, 1)}
    assert messages(lambda: dv.rollout(model, x, 0 * v + 500.0, steps=9, **flight)) == []


# --- what sweeps leave ------------------------------------------------------------------------------------------------


def swinging(sweeps: int, **options: Any) -> tuple[Tensor, list[str]]:
    mesh = dv.mesh.beam(6, 3, 3, size=(0.4, 0.05, 0.05))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)
    x, frames = model.rest_points, []
    solver = dv.VBD(0.005, sweeps, **options)
    said = messages(lambda: frames.append(dv.rollout(model, x, 0 * x, solver, steps=60, young=1e6, poisson=0.3).x))
    return frames[0], said


def test_motion_that_sweeps_leave_wrong_is_warned_of_and_what_is_right_is_not() -> None:
    coarse: dict[str, Any] = {"subspace": "coarse", "relaxation": 1.5}
    right, said = swinging(100, **coarse)
    assert said == []
    for sweeps, options, wrong in ((10, {}, True), (300, {"relaxation": 1.5}, False), (20, coarse, False)):
        motion, said = swinging(sweeps, **options)
        error = float((motion - right).norm() / (right - right[0]).norm())
        assert (error > 0.05) == wrong == any("the motion may be off by" in text for text in said)
        assert all('subspace="coarse"' in text for text in said)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_what_rests_or_has_no_sweeps_to_judge_is_not_doubted(dtype: torch.dtype) -> None:
    model = dv.Model(
        dv.mesh.box(3, 0.2), dtype=dtype, energies=(dv.StableNeoHookean(), dv.FloorBarrier(-0.004, kappa=1e4))
    )
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    many: dict[str, Any] = SOFT | {"solver": dv.VBD(0.01, 100)}
    end = dv.rollout(model, x, v, steps=60, save="last", **many, checks=dv.Checks(energy=False))
    for frames in (10, 40):
        assert messages(lambda n=frames: dv.rollout(model, end.x[-1], end.v[-1], steps=n, **SOFT)) == []


# --- energy from nowhere ----------------------------------------------------------------------------------------------


STIFF: dict[str, Any] = {"mu": 1e9, "lam": 1e9, "solver": dv.VBD(0.01, 2)}


def bent_bar(**options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    """A bar whose velocities bend it."""
    mesh = dv.mesh.box((5, 2, 2), (0.4, 0.1, 0.1))
    model = dv.Model(mesh, **options)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = 20 * x[:, 0].square()
    return model, x, v


def said_of_energy(run: Any, of: str = "gained") -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        run()
    return [str(w.message) for w in found if of in str(w.message)]


# --- energy -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [3, checks.LEAST_CHUNK])  # tets that are looked at together
def test_energy_is_that_of_the_reference(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    monkeypatch.setattr(checks, "LEAST_CHUNK", chunk)
    model, x, v = bent_bar()
    x = x + 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    mu, lam = (torch.linspace(1e4, k, model.num_tets, dtype=x.dtype) for k in (2e4, 5e4))
    system = system_of(model, dv.VBD(1.0, 1))
    prepared = prepare(system, (), material_of(mu=mu, lam=lam), time_step=1.0, sweeps=1)
    expected = reference.incremental_potential(model, x, x, mu, lam, 1.0)
    expected = expected + 0.5 * (model.mass[:, None] * v.square()).sum()
    found = checks.mechanical_energy(system, prepared, x, v)
    assert found.shape == (1,) and expected > 0
    assert abs(found - expected) <= tolerance("energy_gain") * expected
    many = checks.mechanical_energy(system, prepared, x.expand(3, -1, -1), v.expand(3, -1, -1))
    assert torch.allclose(many, found, rtol=tolerance("energy_gain"))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_energy_from_nowhere_is_warned_of_each_time(dtype: torch.dtype) -> None:
    model, x, v = bent_bar(dtype=dtype)
    with pytest.warns(UserWarning, match=r'has gained .* subspace="coarse"') as found:
        dv.rollout(model, x, v, steps=10, **STIFF)
    assert {w.filename for w in found} == {__file__}
    for asked in (None, True):
        assert (
            len(
                said_of_energy(
                    lambda asked=asked: dv.rollout(model, x, v, steps=10, **STIFF, checks=dv.Checks(energy=asked))
                )
            )
            == 1
        )


def pressed(dtype: torch.dtype) -> tuple[dv.Model, Tensor]:
    """A box over a floor and under another one, both closer than dhat."""
    lower, gap = box(3, 0.1), 5e-4
    tets = dv.mesh.join([lower, lower.translate((0.01, 0.1 + gap, 0.0))])
    floor = dv.FloorBarrier(height=-gap, kappa=1e4, dhat=0.01)
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.01, self_contact=False), floor)
    model = dv.Model(tets, energies=energies, dtype=dtype)
    return model, model.rest_points


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_energy_of_barriers_is_counted(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """What barriers hold at the start becomes motion, which is no gain."""
    model, x = pressed(dtype)
    asked = {**SOFT, "mu": 1e5, "lam": 1e5, "solver": dv.VBD(0.005, 20), "checks": dv.Checks(energy=True)}

    def said(**other: Any) -> list[str]:
        return said_of_energy(lambda: dv.rollout(model, x, torch.zeros_like(x), steps=10, **asked | other))

    assert said() == []
    assert said(pair_kappa=torch.tensor(1e3, dtype=dtype), floor_kappa=torch.tensor(1e2, dtype=dtype)) == []
    monkeypatch.setattr(checks, "barrier_energy", lambda model, prepared, x: x.new_zeros(len(x)).double())
    assert len(said()) == 1
    assert len(said(checks=dv.Checks())) == 1


def test_energy_that_barriers_come_to_hold_is_counted_where_one_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though kinetic and elastic energy is largest elsewhere."""
    model, x = pressed(torch.float64)
    v, given = torch.zeros_like(x), {**SOFT, "mu": 1e5, "lam": 1e5, "solver": dv.VBD(0.005, 20)}
    looks = []

    def held(model: Any, prepared: Any, x: Tensor) -> Tensor:
        looks.append(x)
        return x.new_full((len(x),), 1e3 * (len(looks) == 3))  # at the start of the rollout, if any, and of one look

    monkeypatch.setattr(checks, "barrier_energy", held)
    asked = dv.Checks(energy=True)
    assert len(said_of_energy(lambda: dv.rollout(model, x, v, steps=10, **given, checks=asked))) == 1
    assert len(looks) == 11


def test_energy_of_barriers_is_that_of_their_forces() -> None:
    model, x = pressed(torch.float64)
    system = system_of(model, dv.VBD(1.0, 1))
    prepared = prepare(system, (), material_of(mu=1e5, lam=1e5), time_step=1.0, sweeps=1)
    w = torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)

    def energy(step: float) -> float:
        return float(checks.barrier_energy(system, prepared, (x + step * w)[None]))

    work = float((dv.contact.forces(model, x).vertices.normal * w).sum())
    size = 1e-8
    assert energy(0.0) > 0 and abs(work) > 0
    assert (energy(-size) - energy(size)) / (2 * size) == pytest.approx(
        work, rel=tolerance("contact_finite_difference")
    )


def test_each_scene_has_its_gravity() -> None:
    """What gravity gives one is no gain, nor is it lent to others."""
    model, x, v = bent_bar()
    gravity = torch.zeros(2, 3, 1, 3, dtype=x.dtype)
    gravity[0, :, 0, 1] = torch.tensor([-1.0, -9.0, -30.0])
    x, v = x.expand(2, 3, -1, -1), torch.zeros_like(x).expand(2, 3, -1, -1)
    seen = []
    for given in (gravity, gravity.expand(2, 3, model.num_vertices, 3)):
        run = dict(steps=10, **SOFT, gravity=given, checks=dv.Checks(energy=True))
        assert said_of_energy(lambda run=run: seen.append(dv.rollout(model, x, v, **run))) == []
    moved = (seen[0].x[-1] - x).abs().amax((-1, -2))
    assert bool((moved[0, 1:] > moved[0, :-1]).all()) and float(moved[1].amax()) < 1e-12


@pytest.mark.parametrize("other", ["gravity", "speed"])
def test_no_scene_silences_another(other: str) -> None:
    model, x, v = bent_bar()
    x, v = torch.stack([x, x]), torch.stack([v, v])
    gravity = x.new_tensor([[0.0, -9.81, 0.0]]).expand(2, 1, 3).clone()
    if other == "gravity":
        gravity[1] *= 1e3
    else:
        v[1, :, 2] += 1e160
    found = said_of_energy(lambda: dv.rollout(model, x, v, steps=10, **STIFF, gravity=gravity,
                                              checks=dv.Checks(energy=True)))  # fmt: skip
    assert len(found) == 1 and "scene 0 has gained" in found[0]


def test_what_helps_helps() -> None:
    model, x, v = bent_bar()
    solver = dv.VBD(0.01, 100, subspace="coarse", relaxation=1.5)
    assert (
        said_of_energy(
            lambda: dv.rollout(
                model,
                x,
                v,
                steps=10,
                **STIFF | {"solver": solver},
                checks=dv.Checks(energy=True),
            )
        )
        == []
    )


def test_nothing_is_said_of_a_scene_that_gains_none_or_is_driven() -> None:
    model, x, v = bent_bar()
    assert said_of_energy(lambda: dv.rollout(model, x, v, steps=20, **SOFT, checks=dv.Checks(energy=True))) == []
    kinds: list[dict[str, Any]] = [
        {"force": 0 * x},
        {"gravity": lambda k, x, v: 0 * x},
        {"checks": dv.Checks(energy=False)},
    ]
    for driven in kinds:
        assert said_of_energy(lambda d=driven: dv.rollout(model, x, v, steps=20, **STIFF, **d)) == []
    assert said_of_energy(lambda: dv.rollout(model, x, v, steps=9, **STIFF)) == []  # too short to be looked at unasked


def test_rest_and_fall_are_no_gain_in_single_precision_or_far_away() -> None:
    for dtype, distance in ((torch.float32, 1.0), (torch.float32, 1e3), (torch.float64, 1e5)):
        model, x, v = bent_bar(dtype=dtype)
        given = {**SOFT, "mu": 1e7, "lam": 1e7}

        def run(model: dv.Model = model, x: Tensor = x + distance, v: Tensor = 0 * v, given: Any = given) -> Any:
            return dv.rollout(model, x, v, steps=10, **given, checks=dv.Checks(energy=True))

        assert said_of_energy(run) == []


@pytest.mark.parametrize("schedule", [None, 3, dv.BinomialCheckpoints(2)])
def test_gradients_are_those_without_a_look(schedule: Any) -> None:
    model, x, v = bent_bar()
    gradients = []
    for asked in (True, False):
        leaf = v.clone().requires_grad_()
        end = dv.rollout(
            model, x, leaf, steps=10, checkpoint_every=schedule, save="last", **SOFT, checks=dv.Checks(energy=asked)
        )
        gradients.append(torch.autograd.grad(end.x.square().sum(), leaf)[0])
    assert torch.equal(*gradients) and gradients[0].abs().max() > 0


def test_a_scene_that_something_else_drives_is_named_where_one_asks() -> None:
    model, x, v = bent_bar()
    mu = dv.per_step(torch.full((2, 1), 1e4, dtype=x.dtype))
    for given, cause in (({"force": torch.ones_like(x)}, "force"), ({"mu": mu}, "what changes from step to step")):
        inputs = {**SOFT, **given}
        with pytest.warns(UserWarning, match=f"checks: no look at the energy, to which {cause} may add"):
            dv.rollout(model, x, v, steps=2, **inputs, checks=dv.Checks(energy=True))
        assert not messages(lambda inputs=inputs: dv.rollout(model, x, v, steps=2, **inputs))


def test_a_wrong_argument_is_named() -> None:
    model, x, v = bent_bar()
    with pytest.raises(TypeError, match="energy: expected a bool or None, got int"):
        dv.rollout(model, x, v, steps=1, **SOFT, checks=dv.Checks(energy=1))  # pyright: ignore[reportArgumentType]


# --- pairs that truncate, friction that has not converged ------------------------------------------------------------


FAST: dict[str, Any] = {"mu": 2e4, "lam": 4e4, "solver": dv.VBD(0.002, 3)}


def thrown() -> tuple[dv.Model, torch.Tensor, torch.Tensor]:
    """Two boxes that meet at speed."""
    model = two_boxes(detections=1)
    v = torch.zeros_like(model.rest_points)
    v[8:, 1] = -60.0
    return model, model.rest_points, v


def sliding(**friction: float) -> tuple[dv.Model, torch.Tensor, torch.Tensor]:
    floor = dv.FloorBarrier(height=-0.01, kappa=2e3)
    model = dv.Model(box(3, 0.2, split="kuhn"), energies=(dv.StableNeoHookean(), floor, dv.Friction(**friction)))
    v = torch.zeros_like(model.rest_points)
    v[:, 0] = 1e-3
    return model, model.rest_points, v


def test_motion_that_pairs_held_up_is_warned_of() -> None:
    model, x, v = thrown()
    with pytest.warns(UserWarning, match=r"contact: pairs truncated .* larger reach") as found:
        dv.rollout(model, x, v, steps=1, **FAST, checks=dv.Checks(contact=True))
    assert found[0].filename == __file__
    assert sum("pairs truncated" in str(w.message) for w in found) == 1
    assert truncated_fraction(system_of(model, FAST["solver"])) > TRUNCATED


def test_friction_that_has_not_converged_is_warned_of() -> None:
    model, x, v = sliding(coefficient=0.5, velocity=1e-4)
    stiff: dict[str, Any] = {"mu": 1e5, "lam": 2e5}
    with pytest.warns(UserWarning, match=r"friction: .* not balanced .*more sweeps .*a smaller time_step") as found:
        dv.rollout(model, x, v, dv.VBD(0.01, 1), steps=10, **stiff)
    said = [str(w.message) for w in found]  # of the friction, and of the motion
    assert len(said) == 2 and said[1].startswith("sweeps:") and found[0].filename == __file__
    assert messages(lambda: dv.rollout(model, x, v, dv.VBD(0.01, 1), steps=10, **stiff)) == said  # each time
    # at rest by the last of 40 steps
    said = messages(lambda: dv.rollout(model, x, v, dv.VBD(0.01, 1), steps=40, **stiff))
    assert any("after step 10:" in message for message in said)
    soft, x, v = sliding(coefficient=0.5, velocity=0.1)
    assert not messages(lambda: dv.rollout(soft, x, v, dv.VBD(0.01, 400), steps=10, **stiff))


def test_it_is_said_once_by_any_schedule_and_changes_nothing() -> None:
    model, x, v = thrown()
    ends = []
    for every in (None, 3, dv.BinomialCheckpoints(2)):
        for check in (True, False):
            start = v.clone().requires_grad_()

            def run(start: torch.Tensor = start, every: Any = every, check: bool = check) -> None:
                end = dv.rollout(
                    model, x, start, steps=3, checkpoint_every=every, **FAST, checks=dv.Checks(contact=check)
                )
                ends.append((end.x[-1].detach(), torch.autograd.grad(end.x[-1].square().sum(), start)[0]))

            assert sum("pairs truncated" in text for text in messages(run)) == int(check)
    for end, slope in ends[1:]:
        assert torch.equal(end, ends[0][0]) and torch.equal(slope, ends[0][1]) and slope.any()


def test_bad_input() -> None:
    model, x, v = thrown()
    with pytest.raises(TypeError, match="contact: expected a bool or None, got str"):
        dv.rollout(model, x, v, steps=1, **FAST, checks=dv.Checks(contact="yes"))  # pyright: ignore[reportArgumentType]


# --- bodies that start inside out -------------------------------------------------------------------------------------


CUBE = dv.mesh.cube(3)
GIVEN: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "gravity": (0.0, 0.0, 0.0), "solver": dv.VBD(0.01, 2)}


def said(model: dv.Model, x: Tensor, **more: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        dv.rollout(model, x, torch.zeros_like(x), steps=1, **GIVEN, **more)
    return [str(w.message) for w in found if "inverted" in str(w.message)]


def two_cubes(**options: Any) -> tuple[dv.Model, Tensor]:
    model = dv.Model(dv.mesh.join([CUBE, CUBE.translate((3.0, 0.0, 0.0))]), **options)
    return model, model.rest_points.clone()


def mirrored(model: dv.Model, x: Tensor, body: int) -> Tensor:
    out, own = x.clone(), model.body == body
    out[..., own, 1] = -out[..., own, 1]
    return out


@pytest.mark.parametrize("body", (0, 1))
def test_a_mirrored_body_is_named(body: int) -> None:
    model, x = two_cubes()
    (message,) = said(model, mirrored(model, x, body))
    assert f"body {body} in scene 0 are inverted" in message and "mirrored" in message


def test_some_inverted_tets_are_no_mistake() -> None:
    model, x = two_cubes()
    pushed = x.clone()
    pushed[0] = x[model.body == 0].mean(0) + (x[model.body == 0].mean(0) - x[0])  # one corner through its body
    assert dv.diagnose(model, pushed, mu=1e4, lam=1e4).inverted.any()
    assert said(model, pushed) == [] and said(model, x) == []


def leaps(speeds: tuple[float, float], energies: Any = None, **options: Any) -> list[str]:
    """Warnings of two cubes of 1 m that start with these speeds, in steps of 0.01 s."""
    energies = (dv.StableNeoHookean(), dv.PairBarrier()) if energies is None else energies
    model, x = two_cubes(energies=energies)
    v = torch.zeros_like(x)
    v[:, 0] = torch.tensor(speeds, dtype=v.dtype)[model.body]
    found = messages(lambda: dv.rollout(model, x, v, steps=1, **GIVEN, **options))
    return [message for message in found if "more than its size" in message]


def test_a_body_that_leaps_over_another_is_named() -> None:
    (message,) = leaps((0.0, -400.0))
    assert "body 0" in message and "2 m in a step" in message  # beside the mean of both
    (message,) = leaps((0.0, -800.0))
    assert message.startswith("v: ") and "time_step" in message
    assert leaps((0.0, -300.0)) == [] == leaps((900.0, 900.0))
    assert leaps((0.0, -800.0), energies=(dv.StableNeoHookean(),)) == []
    assert leaps((0.0, -800.0), checks=dv.Checks(start=False)) == []


def test_nothing_is_said_where_nobody_asks() -> None:
    model, x = two_cubes()
    other = mirrored(model, x, 0)
    assert said(model, other, checks=dv.Checks(start=False)) == []
    with pytest.warns(UserWarning, match="no StableNeoHookean"):
        loose, x = two_cubes(energies=())
    x = mirrored(loose, x, 0)
    assert messages(lambda: dv.rollout(loose, x, 0 * x, GIVEN["solver"], steps=1)) == []
