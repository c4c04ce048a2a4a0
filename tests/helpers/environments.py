"""Environments that tests compare."""

from typing import TypeAlias

import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("yourdfpy")

from diffvbd import envs

Kind: TypeAlias = type[envs.Environment]
KINDS = (envs.SoftLift, envs.Crawler, envs.TactilePush)
