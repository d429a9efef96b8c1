"""Shared by the tests of the Python package. `PICOFARM_DATASET` names a data set of small rooms."""

import importlib.util
import os

import pytest

import picofarm

# Needs PyTorch, which is too large to install for every run of the tests.
collect_ignore = [] if importlib.util.find_spec("torch") else ["test_torch.py"]


@pytest.fixture(scope="session")
def room() -> picofarm.Scene:
    return picofarm.furnished(3, resolution=16)


@pytest.fixture(scope="session")
def render(room: picofarm.Scene) -> picofarm.Render:
    return room.render(samples=4, bins=128, gate=(1.0, 25.0))


@pytest.fixture(scope="session")
def dataset() -> str:
    return os.environ["PICOFARM_DATASET"]
