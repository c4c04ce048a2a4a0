"""Bad input to what a scene is made of: a ValueError or TypeError that names the argument and says what came."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bad_input import INF, MESH, NAN, doubles, ones, raises, spoiled

import diffvbd as dv

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
    *((name, {name: 10**400}, "1329 bits") for name in ("density", "saturation", "regularization", "relaxation")),
    ("density", {"density": ones().requires_grad_()}, r"requires grad.* density= to a step"),
    ("relaxation", {"relaxation": ones().requires_grad_()}, "requires grad"),
    ("pinned", {"pinned": (MESH.points[:, 0] == 0).astype(int)}, "8 integers that are 0 or 1"),
    ("saturation", {"saturation": 0.0}, "0"),
    ("saturation", {"saturation": -0.1}, "-0.1"),
    ("saturation", {"saturation": NAN}, "nan"),
    *((name, {name: 1e39, "dtype": torch.float32}, r"1e\+39") for name in ("saturation", "regularization")),
    *(
        (name, {"energies": energy, "dtype": torch.float32}, r"1e\+39")
        for name, energy in (
            ("kappa", dv.FloorBarrier(kappa=1e39)),
            ("kappa", dv.PairBarrier(kappa=1e39)),
            ("coefficient", (dv.FloorBarrier(), dv.Friction(1e39))),
            ("stiffness", dv.Anchor(1e39)),
        )
    ),
    ("saturation", {"saturation": "some"}, "str"),
    ("saturation", {"saturation": True}, "bool"),
    ("regularization", {"regularization": -1e-6}, "-1e-06"),
    ("regularization", {"regularization": NAN}, "nan"),
    ("regularization", {"regularization": "some"}, "str|some"),
    ("regularization", {"regularization": None}, "None"),
    ("relaxation", {"relaxation": 0.0}, "0"),
    ("relaxation", {"relaxation": 2.0}, "2"),
    ("relaxation", {"relaxation": -1.0}, "-1"),
    ("relaxation", {"relaxation": NAN}, "nan"),
    ("relaxation", {"relaxation": None}, "None"),
    ("energies", {"energies": ("neo",)}, "str"),
    ("energies", {"energies": (dv.StableNeoHookean,)}, "type"),
    ("energies", {"energies": None}, "None"),
    ("energies", {"energies": (dv.StableNeoHookean(), dv.StableNeoHookean("paper"))}, "two"),
    ("energies", {"energies": (dv.FloorBarrier(), dv.FloorBarrier(1.0))}, "two"),
    ("dtype", {"dtype": torch.float16}, "float16"),
    ("dtype", {"dtype": "float32"}, "float32"),
    # arrays, of which == makes arrays
    *((name, {name: np.arange(2)}, r"\[0,? 1\]|ndarray") for name in ("dtype", "device", "start", "rigid", "coarse")),
]


@pytest.mark.parametrize(("name", "options", "got"), MODELS, ids=lambda a: str(a)[:30].replace("\n", " "))
def test_bad_argument_of_a_model(name: str, options: dict[str, Any], got: str) -> None:
    raises(lambda: dv.Model(**{"mesh": MESH, **options}), name, got)


ENERGIES: list[tuple[str, Callable[[], Any], str]] = [
    ("block", lambda: dv.StableNeoHookean("best"), "best"),
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
        (n, lambda n=n: dv.FloorBarrier(**{n: ones().requires_grad_()}), f"requires grad.*floor_barrier.{n}")
        for n in ("kappa", "dhat", "damping", "height", "normal")
    ),
    *((n, lambda n=n: dv.PairBarrier(**{n: ones().requires_grad_()}), "requires grad") for n in ("kappa", "dhat")),
    ("coefficient", lambda: dv.Friction(ones().requires_grad_()), "requires grad.*friction.coefficient"),
    *(
        (n, lambda n=n: dv.Anchor(**{n: ones(8, 3).requires_grad_()}), f"requires grad.*anchor.{n}")
        for n in ("stiffness", "points")
    ),
    ("vertices", lambda: dv.Model(MESH, energies=(dv.Anchor(1.0, vertices=torch.zeros(7, dtype=torch.bool)),)), "7"),
    ("tape", lambda: dv.ReverseSweep("half"), "half"),
    ("dtype", lambda: dv.Model(MESH).to(dtype=torch.int64), "int64"),
    ("sweeps", lambda: dv.Model(MESH).memory(sweeps=-1), "-1"),
    ("steps", lambda: dv.Model(MESH).memory(sweeps=1, steps=1.5), "1.5"),
    ("scenes", lambda: dv.Model(MESH).memory(sweeps=1, scenes=True), "bool"),
    ("save", lambda: dv.Model(MESH).memory(sweeps=1, save="most"), "most"),
    ("save", lambda: dv.Model(MESH).memory(sweeps=1, save=0), "0"),
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
