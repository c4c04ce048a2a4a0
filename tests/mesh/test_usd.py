"""Claim: what USD's own reader finds in a file is the motion that was written, in metres and seconds."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from diffvbd import mesh as dm
from diffvbd.testing import tolerance

MESH = dm.join([dm.bunny(8), dm.cube(3)])
TIMES = np.array([0.1, 0.11, 0.12, 0.13])
FRAMES = MESH.points + np.sin(40 * TIMES[:, None, None] + MESH.points)


def opened(path: Path) -> tuple[Any, Any]:
    """The stage of a file and the schemas that read it."""
    pxr = pytest.importorskip("pxr.Usd", reason="needs the extra [exchange]")
    from pxr import UsdGeom

    return pxr.Stage.Open(str(path)), UsdGeom


def needs_usd() -> None:
    pytest.importorskip("pxr", reason="needs the extra [exchange]")


@pytest.mark.parametrize("extension", ["usd", "usda", "usdc"])
def test_reader_finds_the_motion(tmp_path: Path, extension: str) -> None:
    needs_usd()
    path = tmp_path / f"motion.{extension}"
    dm.write_series(path, MESH, FRAMES, TIMES)
    stage, geom = opened(path)
    assert geom.GetStageUpAxis(stage) == "Y" and geom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim().GetPath() == "/simulation"
    rate = stage.GetTimeCodesPerSecond()
    assert rate == pytest.approx(100.0, rel=tolerance("closed_form")) and stage.GetFramesPerSecond() == rate
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (10, 13)
    triangles = 0
    for label in (0, 1):
        surface = geom.Mesh(stage.GetPrimAtPath(f"/simulation/body_{label}"))
        assert (
            surface.GetSubdivisionSchemeAttr().Get() == "none" and surface.GetOrientationAttr().Get() == "rightHanded"
        )
        assert surface.GetPointsAttr().GetTimeSamples() == [10, 11, 12, 13]
        faces = np.array(surface.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert set(surface.GetFaceVertexCountsAttr().Get()) == {3} and faces.min() == 0
        triangles += len(faces)
        wanted = MESH.surface[MESH.body[MESH.surface[:, 0]] == label]
        for k, code in enumerate((10, 11, 12, 13)):
            points = np.array(surface.GetPointsAttr().Get(code))
            assert len(points) == faces.max() + 1
            # triangle by triangle, so that order and winding count
            np.testing.assert_allclose(points[faces], FRAMES[k][wanted], rtol=0, atol=2 * tolerance("stored_float32"))
            extent = np.array(surface.GetExtentAttr().Get(code))
            assert np.array_equal(extent, [points.min(0), points.max(0)])
    assert triangles == len(MESH.surface)


def test_values_of_vertices_are_primvars_and_velocities_those_of_points(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    needs_usd()
    mesh = dm.cube(3)
    frames = np.stack([mesh.points, mesh.points + 1])
    values = {"velocities": (2, 27, 3), "s": (2, 27), "w": (2, 27, 3), "uv": (2, 27, 2)}
    data = {name: rng.normal(size=shape) for name, shape in values.items()}
    dm.write_series(tmp_path / "a.usda", mesh, frames, [0.0, 0.5], point_data=data)
    stage, geom = opened(tmp_path / "a.usda")
    surface = geom.Mesh(stage.GetPrimAtPath("/simulation/body"))
    on = np.unique(mesh.surface)
    found = {name: geom.PrimvarsAPI(surface).GetPrimvar(name) for name in ("s", "w", "uv")}
    for k in (0, 1):
        assert np.array_equal(surface.GetVelocitiesAttr().Get(k), data["velocities"][k][on].astype(np.float32))
        for name, primvar in found.items():
            assert primvar.GetInterpolation() == "vertex"
            stored = np.array(primvar.Get(k)).reshape(data[name][k][on].shape)
            assert np.array_equal(stored, data[name][k][on].astype(np.float32))
    assert found["uv"].GetElementSize() == 2


def test_usd_finds_nothing_wrong(tmp_path: Path) -> None:
    needs_usd()
    validation = pytest.importorskip("pxr.UsdValidation", reason="needs usd-core with its validators")
    dm.write_series(tmp_path / "a.usdc", MESH, FRAMES, TIMES, point_data={"velocities": FRAMES})
    stage, _ = opened(tmp_path / "a.usdc")
    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []


def test_one_frame_and_uneven_times(tmp_path: Path) -> None:
    needs_usd()
    dm.write_series(tmp_path / "one.usda", MESH, FRAMES[:1])
    stage, _ = opened(tmp_path / "one.usda")
    assert stage.GetStartTimeCode() == stage.GetEndTimeCode() == 0
    dm.write_series(tmp_path / "uneven.usda", MESH, FRAMES[:3], [0.0, 0.1, 1.0])
    stage, geom = opened(tmp_path / "uneven.usda")
    codes = geom.Mesh(stage.GetPrimAtPath("/simulation/body_1")).GetPointsAttr().GetTimeSamples()
    assert np.array(codes) / stage.GetTimeCodesPerSecond() == pytest.approx([0.0, 0.1, 1.0])


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"velocities": FRAMES[..., 0]}, r"point_data\['velocities'\]: expected shape \[4, \d+, 3\], got \[4, \d+\]"),
        ({"a b": FRAMES}, "point_data: expected names of letters, digits and underscores for USD, got 'a b'"),
    ],
)
def test_values_that_usd_cannot_hold(tmp_path: Path, data: dict, says: str) -> None:
    needs_usd()
    with pytest.raises(ValueError, match=says):
        dm.write_series(tmp_path / "a.usda", MESH, FRAMES, TIMES, point_data=data)
    assert not list(tmp_path.iterdir())


def test_without_its_extra_usd_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ImportError, match=r"writing .usdc needs usd-core: pip install 'diffvbd\[exchange\]'"):
        dm.write_series(tmp_path / "a.usdc", MESH, FRAMES, TIMES)
