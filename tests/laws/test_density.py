"""Claim: a law's density is what its text says: invariants, derivatives, continuation, moduli at rest; a wrong text or
value is named. Nothing is compiled here."""

import inspect
import math
import pickle
import re
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.laws import tets
from diffvbd.laws.density import LEAST_VOLUME, Density, stretch_sum
from diffvbd.laws.law import TAKEN
from diffvbd.model.material import rest_metric, shape_gradients
from diffvbd.testing import relative_error

LOG = "mu/2*(I1 - 3) - mu*log(J) + lam/2*log(J)**2"
COROTATED = "mu*(I1 - 2*trU + 3) + lam/2*(trU - 3)**2"
MOONEY_RIVLIN = "C10*(I1*J**(-2/3) - 3) + C01*(I2*J**(-4/3) - 3) + K/2*(J - 1)**2"
FIBRES = LOG + " + k1/(2*k2)*(exp(k2*(I4 - 1)**2) - 1)"
STABLE = "mu/2*(I1 - 3) - mu*(J - 1) + (mu + lam)/2*(J - 1)**2"
VALUES = {"mu": 1.3, "lam": 2.1, "C10": 0.7, "C01": 0.4, "K": 5.0, "k1": 0.9, "k2": 0.8}
A, B = 1.2, 0.93  # stretches along x and across


def of_log() -> tuple[float, float]:
    mu, lam = VALUES["mu"], VALUES["lam"]
    log = math.log(A * B * B)
    return mu * A + (lam * log - mu) / A, mu * B + (lam * log - mu) / B


def of_corotated() -> tuple[float, float]:
    mu, lam = VALUES["mu"], VALUES["lam"]
    trace = lam * (A + 2 * B - 3)
    return 2 * mu * (A - 1) + trace, 2 * mu * (B - 1) + trace


def of_mooney_rivlin() -> tuple[float, float]:
    j, i1, i2 = A * B * B, A * A + 2 * B * B, 2 * A * A * B * B + B**4

    def along(own: float, of_i2: float) -> float:
        first = VALUES["C10"] * j ** (-2 / 3) * (2 * own - 2 / 3 * i1 / own)
        second = VALUES["C01"] * j ** (-4 / 3) * (of_i2 - 4 / 3 * i2 / own)
        return first + second + VALUES["K"] * (j - 1) * j / own

    return along(A, 4 * A * B * B), along(B, 2 * B * (A * A + B * B))


def of_fibres() -> tuple[float, float]:  # along x
    own, across = of_log()
    e = A * A - 1
    return own + 2 * A * VALUES["k1"] * e * math.exp(VALUES["k2"] * e * e), across


UNIAXIAL = {LOG: of_log, COROTATED: of_corotated, MOONEY_RIVLIN: of_mooney_rivlin, FIBRES: of_fibres}


def make(text: str, **more: Any) -> Any:
    names = Density(text).parameters
    a0 = {"a0": (2.0, 0.0, 0.0)} if "I4" in text else {}
    return dv.law(text, **({name: VALUES[name] for name in names} | a0 | more))


def one_tet(text: str, f: Tensor, a0: Tensor | None = None) -> tuple[Any, Tensor, Tensor]:
    """A law, corners of a tet [1, 4, 3] deformed by f, and the scalars of its rest shape [1, n]."""
    law = make(text)
    corners = torch.tensor([[[0, 0, 0], [1, 0.2, 0], [0.1, 0.9, 0.3], [0.2, 0.1, 1.1]]], dtype=torch.float64)
    parts = [rest_metric(corners[None])[0][0]]
    if law.a0 is not None:
        unit = law.a0 / law.a0.norm() if a0 is None else a0
        parts.append((shape_gradients(corners)[0] * unit).sum(-1))
    parts.append(torch.stack([law.values[p] for p in law.density.parameters])[None])
    return law, corners @ f.T, torch.cat(parts, -1)


@pytest.mark.parametrize("text", UNIAXIAL)
def test_uniaxial_stretch_has_its_closed_form(text: str) -> None:
    """First Piola-Kirchhoff stress of F = diag(a, b, b), by hand."""
    law, corners, rest = one_tet(text, torch.diag(torch.tensor([A, B, B], dtype=torch.float64)))
    cauchy = tets.cauchy(law.density, corners, rest)[0]
    j = A * B * B
    along, across = UNIAXIAL[text]()
    assert cauchy[0, 0].item() * j / A == pytest.approx(along, rel=1e-12)
    assert cauchy[1, 1].item() * j / B == pytest.approx(across, rel=1e-12)
    assert cauchy[2, 2].item() * j / B == pytest.approx(across, rel=1e-12)
    assert cauchy[0, 1].abs() < 1e-12


@pytest.mark.parametrize("text", [*UNIAXIAL, STABLE])
def test_stress_is_the_derivative_of_the_energy(text: str) -> None:
    f = torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(3, 3, dtype=torch.float64)
    law, corners, rest = one_tet(text, f)
    cauchy = tets.cauchy(law.density, corners, rest)[0]
    at = corners.clone().requires_grad_()
    (force,) = torch.autograd.grad(tets.energy(law.density, at, rest).sum(), at)
    # V J sigma = sum over corners of force x^T
    volume = torch.linalg.det(f) / (6 * rest[0, 6])
    assert relative_error(torch.einsum("ai,aj->ij", force[0], corners[0]), volume * cauchy) < 1e-12
    assert cauchy.abs().max() > 0.1


def test_invariants_and_turns() -> None:
    """trU is the sum of singular values, the last with the sign of det F; no rotation changes an energy."""
    f = torch.randn(20, 3, 3, dtype=torch.float64)
    left = f @ f.mT
    i1, j = left.diagonal(dim1=-2, dim2=-1).sum(-1), torch.linalg.det(f)
    i2 = (i1**2 - (left @ left).diagonal(dim1=-2, dim2=-1).sum(-1)) / 2
    values = torch.linalg.svdvals(f)
    expected = values[:, 0] + values[:, 1] + j.sign() * values[:, 2]
    assert bool((j < 0).any()) and bool((j > 0).any())
    assert relative_error(stretch_sum(i1, i2, j), expected) < 1e-9
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn).sign()
    for text in UNIAXIAL:
        stretched = torch.diag(torch.tensor([A, B, 1.1], dtype=torch.float64))
        law, one, rest = one_tet(text, stretched)
        two = one @ turn.T
        assert relative_error(tets.energy(law.density, two, rest), tets.energy(law.density, one, rest)) < 1e-12


@pytest.mark.parametrize("text", [LOG, MOONEY_RIVLIN])
def test_small_volumes_are_continued(text: str) -> None:
    """psi, its first and second derivative by J go on below LEAST_VOLUME, and it rises without a bound."""
    law = make(text)
    given = [law.values[p] for p in law.density.parameters]

    def at(j: Tensor) -> list[Tensor]:
        three = 3 * torch.ones_like(j)
        invariants = [three, three, j, torch.ones_like(j)]
        return [law.density.value(invariants, given)[0], law.density.slopes(invariants, given)[2],
                law.density.curvatures(invariants, given)[7]]  # fmt: skip

    eps = 1e-9
    below, above = at(torch.tensor(LEAST_VOLUME - eps).double()), at(torch.tensor(LEAST_VOLUME + eps).double())
    for one, two in zip(below, above, strict=True):
        assert one.item() == pytest.approx(two.item(), rel=1e-6)
    values = at(torch.tensor([LEAST_VOLUME, 0.0, -1.0, -2.0]).double())[0]
    assert bool((values.diff() > 0).all()) and bool(torch.isfinite(values).all())


def test_moduli_at_rest() -> None:
    for text in (LOG, COROTATED, STABLE, FIBRES):
        law = make(text)
        mu, lam, stress = law.at_rest([law.values[p] for p in law.density.parameters])
        assert (mu.item(), lam.item()) == pytest.approx((VALUES["mu"], VALUES["lam"]), rel=1e-12)
        assert abs(stress.item()) < 1e-12
    law = make(MOONEY_RIVLIN)
    mu, lam, _ = law.at_rest([law.values[p] for p in law.density.parameters])
    shear = 2 * (VALUES["C10"] + VALUES["C01"])
    assert (mu.item(), lam.item()) == pytest.approx((shear, VALUES["K"] - 2 / 3 * shear), rel=1e-12)


def test_stiffness_of_fibres() -> None:
    """4 d2psi/dI4^2 at rest, in the shape of what varies: also where nothing does, and where psi is linear in I4."""

    def real(*shape: int, value: float = 1.0) -> Tensor:
        return torch.full(shape, value, dtype=torch.float64)

    cases = {"k1/(2*k2)*(exp(k2*(I4 - 1)**2) - 1)": ([real(2, 5, value=3e4), real(1, 5, value=2.0)],
                                                     real(2, 5, value=12e4)),
             "5e3*(I4 - 1)**2": ([], real(1, 1, value=4e4)),
             "k*(I4 - 1)": ([real()], real(1, 1, value=0.0))}  # fmt: skip
    for text, (given, expected) in cases.items():
        own = Density("3e4*(I1 - 3) - 6e4*log(J) + " + text).fibre_modulus(given, real(1, 1))
        assert own.shape == expected.shape and torch.allclose(own, expected), text


def test_kinds() -> None:
    """Which laws are quadratic in one vertex, read all edges, or have to be continued."""
    kinds = {text: (d.quadratic, d.edges, d.guarded) for text in (LOG, COROTATED, MOONEY_RIVLIN, STABLE, "c*(I2 - 3)")
             if (d := Density(text))}  # fmt: skip
    assert kinds == {LOG: (False, False, True), COROTATED: (False, True, False), MOONEY_RIVLIN: (False, True, True),
                     STABLE: (True, False, False), "c*(I2 - 3)": (True, True, False)}  # fmt: skip


def test_a_formula_may_have_several_lines() -> None:
    assert Density("mu*(I1\n - 3)").header == Density("mu*(I1 - 3)").header


def test_no_parameter_hides_an_argument() -> None:
    for function in (dv.step, dv.rollout, dv.solve, dv.equilibrium, dv.advise, dv.refine, dv.diagnose, dv.error_budget):
        known = inspect.signature(function).parameters.values()
        assert {p.name for p in known if p.kind is not p.VAR_KEYWORD} <= TAKEN, function


def test_pickles() -> None:
    law = make(FIBRES)
    again = pickle.loads(pickle.dumps(law))
    assert repr(again) == repr(law) and again.density.digest == law.density.digest


@pytest.mark.parametrize(
    ("text", "given", "message"),
    [
        ("mu/2*(I1 - 3", {"mu": 1.0}, "expression: expected an energy density of I1, I2, J, I4, trU"),
        ("mu/2*(I1 - 3) - mu*(J - 1)", {}, "mu: expected a number or a tensor"),
        ("mu/2*(I1 - 3) - mu*(J - 1)", {"mu": 1.0, "lam": 1.0}, "lam: expected a parameter of"),
        ("mu*tanh(J - 1)", {"mu": 1.0}, "expression: expected no functions but log, exp, sqrt, got tanh()"),
        ("mu/0*J", {"mu": 1.0}, "expression: expected an energy density"),
        ("mu*lam", {"mu": 1.0, "lam": 1.0}, "which depends on none of them"),
        ("mu*I1.real", {"mu": 1.0}, "expression: expected an energy density"),
        ("__import__('os')", {}, "expression: expected an energy density"),
        ("density*(I1 - 3)", {"density": 1.0}, "expression: expected parameters with names of their own"),
        ("mu*(I4 - 1)**2", {"mu": 1.0}, "a0: expected directions of fibres with I4"),
        ("mu*(J - 1)**2", {"mu": 1.0, "a0": (1.0, 0.0, 0.0)}, "a0: expected directions of fibres with I4"),
        ("mu*(I4 - 1)**2", {"mu": 1.0, "a0": (0.0, 0.0, 0.0)}, "a0: expected directions of finite length > 0"),
        ("mu*(I4 - 1)**2", {"mu": 1.0, "a0": (1.0, 0.0)}, "a0: expected shape [3] or [T, 3]"),
        ("mu*(J - 1)**2", {"mu": float("nan")}, "mu: expected finite numbers"),
        ("J or I1", {}, "BoolOp: J or I1"),
        ("mu*(J - 1)^2", {"mu": 1.0}, "a power is **"),
        ("lambda*(J - 1)**2", {}, "lambda: no name in Python"),
        ("I1 if J else I2", {}, "IfExp: I1 if J else I2"),
        ("1e400*J", {}, "expression: expected an energy density"),
        ("9**9**9*J", {}, "a power of numbers as an exponent"),
        ("sqrt(k**2)*I1", {"k": 1.0}, "expression: expected k in place of sqrt(k**2)"),
        ("mu*sqrt(I1 - 3)", {"mu": 1.0}, "expression: expected an energy density with finite derivatives"),
        ("steps*(I1 - 3)", {"steps": 1.0}, "'steps', another argument of a step"),
        ("mu*(I1 - 3) + lam*(J - 1)**2", {"mu": [1.0, 2.0], "lam": [1.0, 2.0, 3.0]}, "parameters: expected numbers or"),
        (FIBRES, {"mu": 1.0, "lam": 1.0, "k1": 1.0, "k2": 0.0, "a0": (1.0, 0.0, 0.0)}, "is a finite number [Pa] at F"),
    ],
)
def test_bad_laws_are_named(text: str, given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        dv.law(text, **given)


def test_other_bad_laws() -> None:
    with pytest.raises(TypeError, match="expression: expected text"):
        dv.law(3.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="mu: expected a number, got a tensor that requires grad"):
        dv.law(STABLE, mu=torch.tensor(1.0, requires_grad=True), lam=1.0)
    with pytest.warns(UserWarning, match="has a stress of"):
        dv.law("mu/2*(I1 - 3)", mu=1.0)
    mesh = dv.mesh.beam(2, 2, 2)
    with pytest.raises(ValueError, match=r"energies: expected no StableNeoHookean with a law of your own"):
        dv.Model(mesh, energies=(make(LOG), dv.StableNeoHookean()))
    with pytest.raises(ValueError, match="energies: expected one Law"):
        dv.Model(mesh, energies=(make(LOG), make(STABLE)))
    with pytest.raises(ValueError, match=re.escape(f"mu: expected a number or shape [{mesh.num_tets}]")):
        dv.Model(mesh, energies=(make(LOG, mu=torch.ones(3)),))


def test_no_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    with pytest.raises(RuntimeError, match="takes a C\\+\\+ compiler, and there is no 'no-such-compiler'"):
        dv.Model(dv.mesh.beam(2, 2, 2), energies=(dv.law("c*(J - 1)**2 + c*(I1 - 3 - 2*(J - 1))", c=1.0),))
