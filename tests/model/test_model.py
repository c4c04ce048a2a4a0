"""Model: coloring, masses, pins, copies, presets, and the number of colors against DSATUR."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bad_input import INF, MESH, NAN, doubles, ones, raises, spoiled
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import build_mesh, relative_error, tolerance

STEP = {"mu": 1e4, "lam": 2e4, "solver": dv.VBD(1 / 60, 2)}


def mesh_of(kind: str, size: Any) -> dv.TetMesh:
    if kind in ("kuhn", "five"):
        return dv.mesh.box(size, 1.0, kind)
    return dv.TetMesh(*build_mesh(kind, size))


MESHES = [
    *((kind, n) for kind in ("kuhn", "five") for n in ((2, 2, 2), (5, 3, 3), (4, 4, 4), (7, 5, 3), (9, 9, 9))),
    *(("delaunay", size) for size in ("small", "medium", "large")),
    *(("random", size) for size in ("small", "medium", "large")),
]


@pytest.mark.parametrize(("kind", "size"), MESHES)
@pytest.mark.parametrize("pinned", [None, "face"])
def test_colors_are_a_partition_without_shared_tets(kind: str, size: Any, pinned: Any) -> None:
    mesh = mesh_of(kind, size)
    mask = mesh.points[:, 0] < 0.01 if pinned else np.zeros(mesh.num_vertices, dtype=bool)
    model = dv.Model(mesh, pinned=mask)
    ptr, order = model.color_ptr, model.color_vertices
    assert ptr.dtype == torch.int64 and order.dtype == torch.int64
    assert int(ptr[0]) == 0 and int(ptr[-1]) == len(order) == model.num_active
    assert (ptr.diff() > 0).all() and len(ptr) == model.num_colors + 1
    assert torch.equal(order.sort().values, torch.from_numpy(np.flatnonzero(~mask)))
    color = torch.full((mesh.num_vertices,), -1)
    color[order] = torch.repeat_interleave(torch.arange(model.num_colors), ptr.diff())
    of_tets = color[model.tets].sort(1).values
    assert not ((of_tets[:, 1:] == of_tets[:, :-1]) & (of_tets[:, 1:] >= 0)).any()


def test_coloring_depends_on_nothing_but_the_mesh() -> None:
    first, second = (dv.Model(mesh_of("delaunay", "medium")) for _ in range(2))
    assert torch.equal(first.color_vertices, second.color_vertices) and torch.equal(first.color_ptr, second.color_ptr)


# --- masses, density, pins --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["structured", "delaunay", "random"])
def test_masses_sum_to_density_times_volume(kind: str) -> None:
    mesh = dv.TetMesh(*build_mesh(kind, "medium"))
    density = torch.linspace(100.0, 3000.0, mesh.num_tets, dtype=torch.float64)
    model = dv.Model(mesh, density=density)
    total = float((density * torch.from_numpy(mesh.volume.copy())).sum())
    assert abs(float(model.mass.sum()) - total) <= tolerance("sum") * total
    expected = np.zeros(mesh.num_vertices)
    np.add.at(expected, mesh.tets, (density.numpy() * mesh.volume / 4)[:, None])
    assert relative_error(model.mass, torch.from_numpy(expected)) <= tolerance("formula")
    assert torch.equal(model.density, density)
    assert torch.equal(dv.Model(mesh, density=700).density, torch.full((mesh.num_tets,), 700.0, dtype=torch.float64))


@pytest.mark.parametrize(
    "pinned",
    [[3, 0, 3], (0, 3), np.array([0, 3]), torch.tensor([0, 3]), torch.tensor([0, 3], dtype=torch.int32),
     np.isin(np.arange(8), (0, 3)), torch.tensor([True, False, False, True, False, False, False, False])],
)  # fmt: skip
def test_pins_by_mask_or_indices(pinned: Any) -> None:
    model = dv.Model(dv.mesh.cube(split="kuhn"), pinned=pinned)
    assert model.pinned.dtype == torch.bool
    assert model.pinned.nonzero().reshape(-1).tolist() == [0, 3]
    x, _ = dv.step(model, model.rest_points, torch.ones(8, 3, dtype=torch.float64), **STEP)
    still = (x == model.rest_points).all(-1)
    assert still.nonzero().reshape(-1).tolist() == [0, 3]


# --- what a Model shows -----------------------------------------------------------------------------------------------


def test_repr_says_what_it_is() -> None:
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(damping=3.0), dv.Anchor(2.0))
    model = dv.Model(dv.mesh.beam(5, 3, 3, split="kuhn"), pinned=[0, 1], energies=energies)
    text = repr(model)
    for part in ("45 vertices", "96 tets", "2 pinned", f"{model.num_colors} colors", "20 kg", "StableNeoHookean",
                 "FloorBarrier", "damping=3.0", "Anchor", "stiffness=2.0", "float64", "cpu"):  # fmt: skip
        assert part in text, part
    assert "\n" not in text and len(text) < 700
    assert "float32" in repr(dv.Model(dv.mesh.cube(split="kuhn"), dtype=torch.float32))
    told = str(dv.VBD.paper(0.25, 7, relaxation=1.5, subspace="coarse", block="exact", saturation=None))
    assert told == "h = 0.25 s, ImplicitEuler, K = 7, relaxation 1.5, coarse"
    assert str(dv.VBD.paper(0.01, 1, subspace=None)).endswith('plain, block="paper"')


def test_inputs_are_declared_by_energies() -> None:
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=300.0), dv.Friction(0.3))
    table = dv.Model(dv.mesh.cube(split="kuhn"), energies=energies).inputs
    assert (table["floor_kappa"].unit, table["floor_kappa"].default) == ("N/m", "300")
    assert table["friction"].source == "Friction" and table["young"].source == "StableNeoHookean"
    assert "anchor_stiffness" not in table and len(str(table).splitlines()) == len(table) + 1
    bare = dv.Model(dv.mesh.cube(split="kuhn"), energies=()).inputs
    assert set(bare) == {"force", "gravity", "prescribed", "colliders", "colliders_before", "rest_points", "density",
                         "drag"}  # fmt: skip


def test_paper_preset() -> None:
    model = dv.Model(dv.mesh.cube(split="kuhn"), density=700.0, pinned=[0])
    solver = dv.VBD.paper(1 / 60, 2)
    assert (solver.block, solver.saturation, solver.regularization, solver.relaxation) == ("paper", 0.1, 1e-6, 1.0)
    assert dv.VBD.paper(1 / 60, 2, saturation=0.2).saturation == 0.2
    same = dv.VBD(1 / 60, 2, block="paper", saturation=0.1, regularization=1e-6)
    assert solver == same and dv.VBD(1 / 60, 2) != same
    ends = [dv.step(model, model.rest_points, torch.ones(8, 3, dtype=torch.float64), **STEP | {"solver": each})[0]
            for each in (solver, same, STEP["solver"])]  # fmt: skip
    assert torch.equal(ends[0], ends[1]) and not torch.equal(ends[0], ends[2])


# --- copies -----------------------------------------------------------------------------------------------------------


def tensors_of(model: dv.Model) -> dict[str, Tensor]:
    return {k: t for k, t in vars(model).items() if isinstance(t, Tensor)} | dict(
        zip(("tets", "star_ptr", "star"), model._topology, strict=True)
    )


def test_to_returns_a_new_model_and_keeps_the_old() -> None:
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-1 / 3), dv.Anchor(0.1))
    model = dv.Model(dv.mesh.box((3, 3, 2), 0.1, split="kuhn"), density=123.4, pinned=[1], energies=energies)
    before = {k: t.clone() for k, t in tensors_of(model).items()}
    single = model.to(dtype=torch.float32)
    assert single is not model and single.dtype == torch.float32 and model.dtype == torch.float64
    for name, t in tensors_of(model).items():
        assert torch.equal(t, before[name]) and t.dtype == before[name].dtype, name
    for name, t in tensors_of(single).items():
        expected = before[name].float() if before[name].is_floating_point() else before[name]
        assert t.dtype == expected.dtype and torch.equal(t, expected), name
    # a way through float32 loses nothing
    again = single.to(dtype=torch.float64)
    for name, t in tensors_of(again).items():
        assert torch.equal(t, before[name]), name
    assert torch.equal(model.to("cpu").mass, model.mass) and model.to("cpu") is not model
    direct = dv.Model(dv.mesh.box((3, 3, 2), 0.1, split="kuhn"), 123.4, [1], energies, dtype=torch.float32)
    for name, t in tensors_of(direct).items():
        assert torch.equal(t, tensors_of(single)[name]), name


def test_a_device_without_kernels_raises() -> None:
    """Moves to CUDA are in test_cuda_device.py."""
    model = dv.Model(dv.mesh.cube(split="kuhn"))
    for device in ("meta", torch.device("meta"), "xpu:1"):
        with pytest.raises(ValueError, match=r"device: .*cpu.*cuda.*, got '(meta|xpu:1)'"):
            model.to(device)
        with pytest.raises(ValueError, match="device: "):
            dv.Model(dv.mesh.cube(split="kuhn"), device=device)
    assert model.device.type == "cpu" and all(t.device.type == "cpu" for t in tensors_of(model).values())


# --- degenerate models ------------------------------------------------------------------------------------------------


def gradients(model: dv.Model, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    x, v = x.clone().requires_grad_(), torch.ones_like(x).requires_grad_()
    new, speed = dv.step(model, x, v, **STEP)
    return (new.detach(), *torch.autograd.grad(new.sum() + speed.sum(), (x, v), allow_unused=True))


@pytest.mark.parametrize("batch", [(), (2,)])
def test_an_empty_mesh_is_legal(batch: tuple[int, ...]) -> None:
    model = dv.Model(dv.TetMesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=int)))
    assert (model.num_vertices, model.num_tets, model.num_colors) == (0, 0, 0)
    assert "0 vertices" in repr(model)
    x = torch.zeros(*batch, 0, 3, dtype=torch.float64)
    new, by_x, _ = gradients(model, x)
    assert new.shape == x.shape and by_x.shape == x.shape
    trajectory = dv.rollout(model, x, x, steps=2, **STEP)
    assert trajectory.x.shape == (3, *x.shape)
    assert dv.memory(model, STEP["solver"])["total"] >= 0
    for dtype in (torch.float32, torch.float64):
        assert dv.step(model.to(dtype=dtype), x.to(dtype), x.to(dtype), **STEP)[0].shape == x.shape


def test_a_batch_without_scenes_is_legal() -> None:
    model = dv.Model(dv.mesh.cube(split="kuhn"))
    new, by_x, _ = gradients(model, torch.zeros(0, 8, 3, dtype=torch.float64))
    assert new.shape == (0, 8, 3) and by_x.shape == (0, 8, 3)


def test_vertices_without_tets_are_legal_when_pinned() -> None:
    mesh = dv.mesh.cube(split="kuhn")
    loose = dv.TetMesh(np.concatenate([mesh.points, [[5.0, 5.0, 5.0]]]), mesh.tets)
    model = dv.Model(loose, pinned=[8])
    force = torch.ones(9, 3, dtype=torch.float64).requires_grad_()
    x, v = dv.step(model, model.rest_points, torch.ones(9, 3, dtype=torch.float64), force=force, **STEP)
    expected = dv.step(dv.Model(mesh), model.rest_points[:8], torch.ones(8, 3, dtype=torch.float64),
                       force=force[:8].detach(), **STEP)  # fmt: skip
    assert torch.equal(x[:8], expected[0]) and x[8].tolist() == [5.0, 5.0, 5.0] and v[8].tolist() == [0.0, 0.0, 0.0]
    (slope,) = torch.autograd.grad(x.sum(), force)
    assert torch.isfinite(slope).all() and slope[8].abs().max() == 0 and slope[:8].abs().max() > 0


def test_a_model_without_elastic_energy_falls_freely() -> None:
    model = dv.Model(dv.mesh.cube(split="kuhn"), energies=())
    v = torch.full((8, 3), 2.0, dtype=torch.float64)
    x, _ = dv.step(model, model.rest_points, v, dv.VBD(0.1, 3))
    expected = model.rest_points + 0.1 * v + 0.01 * torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64)
    assert relative_error(x, expected) <= tolerance("ulps")


def test_safeguards_out_of_scale_warn() -> None:
    def step(size: float, solver: dv.VBD) -> None:
        model = dv.Model(dv.mesh.cube(size=size, split="kuhn"))
        dv.step(model, model.rest_points, 0 * model.rest_points, solver, mu=1e4, lam=2e4)

    for solver, message in ((dv.VBD.paper(0.01, 1), "regularization: 1e-06 kg is 0.44"),
                            (dv.VBD(0.01, 1, relaxation=1.9), "relaxation: .* got 1.9"),
                            (dv.VBD(0.01, 1, relaxation=1.6, block="paper"), "may diverge")):  # fmt: skip
        with pytest.warns(UserWarning, match=message):
            step(0.003, solver)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        step(1.0, dv.VBD.paper(0.01, 1))
        step(0.003, dv.VBD(0.01, 1, relaxation=1.6))


# --- bad input --------------------------------------------------------------------------------------------------------


LOOSE = dv.TetMesh(np.concatenate([MESH.points, np.ones((2, 3)) * 3]), MESH.tets)

MODELS: list[tuple[str, dict[str, Any], str]] = [
    ("mesh", {"mesh": "beam.msh"}, "str"),
    ("mesh", {"mesh": (MESH.points, MESH.tets)}, "tuple"),
    ("mesh", {"mesh": LOOSE}, "2 isolated vertices: 8, 9"),
    ("mesh", {"mesh": LOOSE, "pinned": [8]}, "1 isolated vertices: 9"),
    *(("density", {"density": bad}, str(bad)) for bad in (-1.0, 0.0, NAN, INF)),
    ("density", {"density": doubles(1.0, 1.0, -3.0, 1.0, 1.0, 1.0)}, "-3"),
    ("density", {"density": doubles(1.0, 1.0, 1.0, 1.0, INF, 1.0)}, "inf"),
    ("density", {"density": ones(8)}, r"\[8\]"),
    ("density", {"density": "steel"}, "str"),
    ("density", {"density": True}, "bool"),
    ("density", {"density": None}, "None"),
    ("pinned", {"pinned": [8]}, "8"),
    ("pinned", {"pinned": [0, -1]}, "-1"),
    ("pinned", {"pinned": [0.5]}, "float"),
    ("pinned", {"pinned": torch.zeros(7, dtype=torch.bool)}, r"\[7\]"),
    ("pinned", {"pinned": "left"}, "str|left"),
    ("pinned", {"pinned": torch.ones(8, dtype=torch.uint8)}, r"uint8.* use \.bool\(\) for a mask, \.long\(\) for"),
    ("pinned", {"pinned": np.ones(8, dtype=np.uint8)}, "uint8"),
    ("pinned", {"pinned": torch.ones(8, dtype=torch.bool, device="meta")}, "meta"),
    ("pinned", {"pinned": torch.ones(8).bool().to_sparse()}, "sparse"),
    ("pinned", {"pinned": torch.ones(8, dtype=torch.complex64)}, "complex64"),
    ("pinned", {"pinned": [10**400]}, "list"),
    ("density", {"density": torch.ones(6, device="meta")}, "meta"),
    ("density", {"density": torch.ones(6).to_sparse()}, "sparse"),
    ("density", {"density": 10**400}, "1329 bits"),
    ("density", {"density": ones().requires_grad_()}, r"requires grad.* density= to a step"),
    ("pinned", {"pinned": (MESH.points[:, 0] == 0).astype(int)}, "8 integers that are 0 or 1"),
    *(
        (name, {"energies": energy, "dtype": torch.float32}, r"1e\+39")
        for name, energy in (
            ("kappa", dv.FloorBarrier(kappa=1e39)),
            ("kappa", dv.PairBarrier(kappa=1e39)),
            ("coefficient", (dv.FloorBarrier(), dv.Friction(1e39))),
            ("stiffness", dv.Anchor(1e39)),
        )
    ),
    ("energies", {"energies": ("neo",)}, "str"),
    ("energies", {"energies": (dv.StableNeoHookean,)}, "the class StableNeoHookean"),
    ("energies", {"energies": None}, "None"),
    ("energies", {"energies": (dv.StableNeoHookean(), dv.StableNeoHookean())}, "two"),
    ("energies", {"energies": (dv.FloorBarrier(), dv.FloorBarrier(1.0))}, "two"),
    ("dtype", {"dtype": torch.float16}, "float16"),
    ("dtype", {"dtype": "float32"}, "float32"),
    # arrays, of which == makes arrays
    *((name, {name: np.arange(2)}, r"\[0,? 1\]|ndarray") for name in ("dtype", "device")),
]


@pytest.mark.parametrize(("name", "options", "got"), MODELS, ids=lambda a: str(a)[:30].replace("\n", " "))
def test_bad_argument_of_a_model(name: str, options: dict[str, Any], got: str) -> None:
    raises(lambda: dv.Model(**{"mesh": MESH, **options}), name, got)


SOLVERS: list[tuple[str, Any, str]] = [
    *((name, 10**400, "1329 bits") for name in ("saturation", "regularization", "relaxation")),
    *((name, ones().requires_grad_(), "requires grad") for name in ("saturation", "regularization", "relaxation")),
    *(
        ("saturation", bad, got)
        for bad, got in ((0.0, "0"), (-0.1, "-0.1"), (NAN, "nan"), ("some", "str"), (True, "bool"))
    ),
    *(("regularization", bad, got) for bad, got in ((-1e-6, "-1e-06"), (NAN, "nan"), ("some", "str"), (None, "None"))),
    *(("relaxation", bad, got) for bad, got in ((0.0, "0"), (2.0, "2"), (-1.0, "-1"), (NAN, "nan"), (None, "None"))),
    *((name, "best", "best") for name in ("block", "start", "tape", "subspace")),
    # arrays, of which == makes arrays
    *((name, np.arange(2), r"\[0,? 1\]|ndarray") for name in ("block", "start", "tape", "subspace")),
]


@pytest.mark.parametrize(("name", "value", "got"), SOLVERS, ids=lambda a: str(a)[:30].replace("\n", " "))
def test_bad_argument_of_a_solver(name: str, value: Any, got: str) -> None:
    raises(lambda: dv.VBD(**{"time_step": 0.01, "sweeps": 1, name: value}), name, got)


@pytest.mark.parametrize("name", ("saturation", "regularization"))
def test_numbers_of_a_solver_that_float32_cannot_hold(name: str) -> None:
    model = dv.Model(MESH, dtype=torch.float32)
    solver = dv.VBD(0.01, 1, **{name: 1e39})
    raises(lambda: dv.step(model, model.rest_points, 0 * model.rest_points, solver, mu=1.0, lam=1.0), name, r"1e\+39")


ENERGIES: list[tuple[str, Callable[[], Any], str]] = [
    *((n, lambda n=n: dv.FloorBarrier(**{n: -1.0}), "-1") for n in ("kappa", "dhat", "damping")),
    *((n, lambda n=n: dv.FloorBarrier(**{n: NAN}), "nan") for n in ("kappa", "dhat", "damping", "height")),
    *((n, lambda n=n: dv.FloorBarrier(**{n: True}), "bool|True") for n in ("kappa", "dhat", "damping")),
    *((n, lambda n=n: dv.FloorBarrier(**{n: None}), "None") for n in ("kappa", "dhat", "damping", "height", "normal")),
    ("dhat", lambda: dv.FloorBarrier(dhat=0.0), "0"),
    ("height", lambda: dv.FloorBarrier(height=[]), "none"),
    ("normal", lambda: dv.FloorBarrier(normal=(0.0, 0.0, 0.0)), "0"),
    ("normal", lambda: dv.FloorBarrier(normal=(0.0, NAN, 0.0)), "nan"),
    ("normal", lambda: dv.FloorBarrier(normal=(0.0, 1.0)), "2"),
    ("normal", lambda: dv.FloorBarrier(normal=[(0, 1, 0)] * 9), "9"),
    ("height", lambda: dv.FloorBarrier(height=(0.0, 1.0), normal=[(0, 1, 0)] * 3), "2 values"),
    ("stiffness", lambda: dv.Anchor(-1.0), "-1"),
    ("stiffness", lambda: dv.Anchor(NAN), "nan"),
    ("stiffness", lambda: dv.Anchor(None), "None"),
    ("stiffness", lambda: dv.Model(MESH, energies=(dv.Anchor(ones(7)),)), r"\[7\]"),
    ("points", lambda: dv.Model(MESH, energies=(dv.Anchor(1.0, points=ones(7, 3)),)), r"\[7, 3\]"),
    ("points", lambda: dv.Model(MESH, energies=(dv.Anchor(1.0, points=spoiled(NAN, 2, 2)),)), "nan"),
    ("vertices", lambda: dv.Model(MESH, energies=(dv.Anchor(1.0, vertices=[9]),)), "9"),
    ("vertices", lambda: dv.Model(MESH, energies=(dv.Anchor(1.0, vertices=[0.5]),)), "float"),
    ("vertices", lambda: dv.Anchor(1.0, vertices=torch.ones(8, dtype=torch.uint8)), r"uint8.*\.bool\(\)"),
    ("vertices", lambda: dv.Anchor(1.0, vertices=torch.ones(8, dtype=torch.bool, device="meta")), "meta"),
    ("stiffness", lambda: dv.Anchor(ones(8).to("meta")), "meta"),
    ("points", lambda: dv.Anchor(1.0, points=ones(8, 3).to_sparse()), "sparse"),
    *((n, lambda n=n: dv.FloorBarrier(**{n: 10**400}), "float|bits") for n in ("kappa", "dhat", "damping", "height")),
    *((n, lambda n=n: dv.PairBarrier(**{n: 10**400}), "bits") for n in ("kappa", "dhat", "damping", "reach")),
    *((n, lambda n=n: dv.Friction(**{n: 10**400}), "bits") for n in ("coefficient", "velocity")),
    *(
        (n, lambda n=n: dv.FloorBarrier(**{n: ones().requires_grad_()}), f"requires grad.*floor_{n}")
        for n in ("kappa", "dhat", "damping", "height", "normal")
    ),
    *((n, lambda n=n: dv.PairBarrier(**{n: ones().requires_grad_()}), "requires grad") for n in ("kappa", "dhat")),
    ("coefficient", lambda: dv.Friction(ones().requires_grad_()), "requires grad.*friction"),
    *(
        (n, lambda n=n: dv.Anchor(**{n: ones(8, 3).requires_grad_()}), f"requires grad.*anchor_{n}")
        for n in ("stiffness", "points")
    ),
    ("vertices", lambda: dv.Model(MESH, energies=(dv.Anchor(1.0, vertices=torch.zeros(7, dtype=torch.bool)),)), "7"),
    ("dtype", lambda: dv.Model(MESH).to(dtype=torch.int64), "int64"),
    ("device", lambda: dv.Model(MESH).to(torch.float32), r"give it as to\(dtype=torch.float32\)"),
    *(
        (n, lambda n=n, bad=bad: dv.memory(dv.Model(MESH), dv.VBD(0.01, 1), **{n: bad}), got)
        for n, bad, got in (("steps", 1.5, "1.5"), ("scenes", True, "bool"), ("save", "most", "most"), ("save", 0, "0"))
    ),
]


@pytest.mark.parametrize(("name", "build", "got"), ENERGIES, ids=lambda a: a if isinstance(a, str) else "")
def test_bad_parameter_of_an_energy_or_option(name: str, build: Callable[[], Any], got: str) -> None:
    raises(build, name, got)


@pytest.mark.parametrize(
    ("name", "points", "tets", "got"),
    [("tets", MESH.points, MESH.tets[:, [1, 0, 2, 3]], "inverted 6 tets"),
     ("tets", MESH.points * [1, 1, 0], MESH.tets, "zero volume in 6 tets"),
     ("tets", MESH.points, MESH.tets + 1, "8"),
     ("tets", MESH.points, MESH.tets - 1, "-1"),
     ("tets", MESH.points, MESH.tets.astype(float), "float64"),
     ("points", np.where(MESH.points == 1, NAN, MESH.points), MESH.tets, "NaN")],
)  # fmt: skip
def test_bad_mesh(name: str, points: Any, tets: Any, got: str) -> None:
    raises(lambda: dv.TetMesh(points, tets), name, got)
