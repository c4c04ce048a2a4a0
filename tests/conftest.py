"""Setup shared by all tests."""

import os

# Idle OpenMP threads must sleep, not spin, on a shared machine; read when torch is loaded, so it comes first.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import hypothesis
import numpy as np
import pytest
import torch

# No deadline: times on a shared machine say nothing. Derandomized: the suite tests the same cases on every machine.
hypothesis.settings.register_profile("suite", deadline=None, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("suite")


def pytest_configure() -> None:
    torch.set_num_threads(min(4, os.cpu_count() or 1))


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
