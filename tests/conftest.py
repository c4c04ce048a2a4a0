"""Setup shared by all tests: the devices they run on, seeds, and what may be missing on a machine."""

import contextlib
import functools
import os
from collections.abc import Generator, Iterator
from typing import Any

# Idle OpenMP threads must sleep, not spin, on a shared machine; read when torch is loaded, so it comes first.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import hypothesis
import numpy as np
import pytest
import torch

# No deadline: times on a shared machine say nothing. Derandomized: the suite tests the same cases on every machine.
hypothesis.settings.register_profile("suite", deadline=None, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("suite")


@functools.cache
def why_no_cuda() -> str | None:
    """What keeps the tests off CUDA on this machine, or None."""
    if not torch.cuda.is_available():
        return "torch sees no CUDA device"
    from diffvbd.ops import load as native

    try:
        native.require_cuda()
    except RuntimeError as error:
        return str(error)
    return None


DEVICES = ["cpu"] if why_no_cuda() else ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def pytest_configure(config: pytest.Config) -> None:
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    torch.set_num_threads(max(1, min(4, (os.cpu_count() or 1) // workers)))


def pytest_report_header() -> str:
    return f"cuda tests: {'no, ' + reason if (reason := why_no_cuda()) else torch.cuda.get_device_name()}"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without CUDA its tests are deselected, not skipped: a line for each would hide what is skipped for a reason."""
    if why_no_cuda():
        gone = [item for item in items if item.get_closest_marker("cuda")]
        items[:] = [item for item in items if not item.get_closest_marker("cuda")]
        config.hook.pytest_deselected(items=gone)


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call() -> Generator[None, Any, Any]:
    """Delaunay meshes and root finding need scipy, which machines that only run the kernels may lack."""
    try:
        return (yield)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != "scipy":
            raise
        pytest.skip("needs scipy")


@pytest.fixture(autouse=True)
def growth_is_measured_where_asked(request: pytest.FixtureRequest) -> Iterator[None]:
    """Whether vibrations grow takes up to 24 steps of each new scene, and there are thousands: tests of it ask for it
    by MEASURES_GROWTH."""
    from diffvbd.step.warnings import proven

    with contextlib.nullcontext() if getattr(request.module, "MEASURES_GROWTH", False) else proven():
        yield


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """Where a test runs: "cpu", and "cuda" where that can be."""
    return request.param


@pytest.fixture
def one_regime(device: str) -> Iterator[None]:
    """For comparisons to the bit between calls of different size, whose regimes may differ: all in the one that runs
    any scene. They must also be so small that a warp works on each vertex (regimes.MANY_LANES_VERTICES)."""
    from diffvbd.testing import regime

    with regime("color") if device == "cuda" else contextlib.nullcontext():
        yield


@pytest.fixture
def value_checks(device: str) -> Iterator[None]:
    """CUDA looks at values only inside debug_checks(), the CPU always."""
    from diffvbd.testing import debug_checks

    with debug_checks(device == "cuda"):
        yield
