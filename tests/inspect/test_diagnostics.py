"""`diagnose` names each limit that a state, a step or a Model crosses, and nothing else."""

import warnings

import pytest
import torch

import diffvbd as dv
from diffvbd.inspect.diagnose import collapse_stretch, diagnose
from diffvbd.testing import tolerance

MATERIAL = {"mu": 1e5, "lam": 1.5e5}


def cube(size: float = 1.0, **options) -> dv.Model:
    mesh = dv.mesh.cube(3, size=size, split="kuhn")
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9 * size, **options)


def only(messages: list[str], word: str) -> None:
    assert len(messages) == 1 and word in messages[0], messages


def test_rest_state_is_clean() -> None:
    model = cube()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = diagnose(model, model.rest_points, time_step=1 / 60, **MATERIAL)
    assert result.ok
    assert result.smallest_volume_ratio == pytest.approx(1)
    assert result.largest_strain < tolerance("geometry")
    assert "smallest J" in str(result)


@pytest.mark.parametrize("ratio", [0.0, 1.0, 100.0])
def test_collapse_is_found_below_the_critical_stretch_only(ratio: float) -> None:
    model = cube()
    mu, lam = 1e4, 1e4 * ratio
    s = float(collapse_stretch(torch.tensor(mu).double(), torch.tensor(lam).double()))
    assert s**3 + s**2 + s == pytest.approx(1 / (1 + ratio))
    for stretch, lost in ((0.99 * s, True), (1.01 * s, False)):
        result = diagnose(model, stretch * model.rest_points, mu=mu, lam=lam, warn=False)
        assert result.collapsing.all() == lost and result.collapsing.any() == lost
        assert result.collapse_margin == pytest.approx(stretch / s)
        assert any("F = 0" in m for m in result.messages) == lost


def test_inverted_tets_are_counted_in_every_scene() -> None:
    model = cube()
    x = torch.stack([model.rest_points, model.rest_points * torch.tensor([-1.0, 1.0, 1.0])])
    result = diagnose(model, x, warn=False, **MATERIAL)
    assert result.inverted.sum(-1).tolist() == [0, model.num_tets]
    only(result.messages, "inverted")


def test_strain_and_nonfinite_positions() -> None:
    model = cube()
    only(diagnose(model, 100 * model.rest_points, warn=False, **MATERIAL).messages, "strain")
    x = model.rest_points.clone()
    x[5, 1] = float("nan")
    result = diagnose(model, x, warn=False, **MATERIAL)
    assert result.nonfinite.nonzero().tolist() == [[5]]
    assert "NaN" in result.messages[0]


def test_settings_that_do_not_promise_descent() -> None:
    def messages(lam: float = 1.5e5, **options) -> list[str]:
        model = cube(**options)
        return diagnose(model, model.rest_points, mu=1e5, lam=lam, warn=False).messages

    paper = (dv.StableNeoHookean("paper"),)
    only(messages(lam=5e4, energies=paper), "lam < mu")
    only(messages(energies=paper, relaxation=1.6), "relaxation")
    only(messages(relaxation=1.9), "relaxation")
    assert any("bulk modulus" in m for m in messages(lam=-8e4))
    assert messages(lam=5e4) == []


def test_leftover_force_falls_with_sweeps_and_knows_every_energy() -> None:
    mesh = dv.mesh.cube(3, split="kuhn")
    floor = dv.FloorBarrier(height=-0.01, kappa=1e4)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), floor, dv.Anchor(100.0)))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    force = torch.full_like(x, 3.0)
    options = {"time_step": 1 / 60, "force": force, **MATERIAL}
    left = []
    for sweeps in (1, 10, 1000):
        end, _ = dv.step(model, x, v, sweeps=sweeps, **options)
        left.append(diagnose(model, end, previous=(x, v), warn=False, **options).unbalanced)
    assert left[0] > left[1] > left[2]
    assert left[2] < tolerance("closed_form")
    stiff = {"time_step": 1 / 60, "mu": 1e8, "lam": 1e8}
    end, _ = dv.step(model, x, v, sweeps=1, **stiff)
    with pytest.warns(UserWarning, match="sweeps or a smaller time step, or relaxation between"):
        diagnose(model, end, previous=(x, v), **stiff)
    over = dv.Model(mesh, energies=model.energies, relaxation=1.6)
    with pytest.warns(UserWarning, match="sweeps or a smaller time step$"):
        diagnose(over, end, previous=(x, v), **stiff)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_free_fall_leaves_no_force(dtype: torch.dtype) -> None:
    model = dv.Model(dv.mesh.cube(3, size=0.1, split="kuhn"), dtype=dtype)
    given = {"mu": 1e5, "lam": 1e5, "time_step": 0.01}
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    motion = dv.rollout(model, x, v, steps=20, sweeps=10, **given)
    found = dv.diagnose(model, motion.x[-1], previous=(motion.x[-2], motion.v[-2]), warn=False, **given)
    assert (motion.x[-1] - x)[:, 1].max() < -0.1 and found.unbalanced == 0.0 and found.ok


def test_pinned_reactions_are_no_residual() -> None:
    model = cube()
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    prescribed = torch.where(model.pinned[:, None], x + 0.01, torch.nan)
    end, _ = dv.step(model, x, v, time_step=1 / 60, sweeps=2000, prescribed=prescribed, **MATERIAL)
    result = diagnose(model, end, time_step=1 / 60, previous=(x, v), prescribed=prescribed, warn=False, **MATERIAL)
    assert result.unbalanced is not None and result.unbalanced < tolerance("closed_form")


def test_courant_number_counts_elements_per_step() -> None:
    model = cube()
    result = diagnose(model, model.rest_points, time_step=0.1, **MATERIAL, warn=False)
    # the shortest height of a Kuhn tet with legs a is a / sqrt(2)
    assert result.courant == pytest.approx(0.1 * (3.5e5 / 1000) ** 0.5 / (0.5 / 2**0.5))
    assert diagnose(model, model.rest_points, warn=False, **MATERIAL).courant is None


def test_bad_arguments() -> None:
    model = cube()
    x = model.rest_points
    with pytest.raises(ValueError, match="time_step"):
        diagnose(model, x, previous=(x, x), **MATERIAL)
    with pytest.raises(ValueError, match="x: expected shape"):
        diagnose(model, x[:-1], **MATERIAL)
    for mu, error in ((torch.ones(7, dtype=x.dtype), ValueError), (float("nan"), ValueError), ("soft", TypeError)):
        with pytest.raises(error, match="^mu: expected"):
            diagnose(model, x, mu=mu, lam=1e4)  # pyright: ignore[reportArgumentType]
