"""The tiny world, once for all tests of data sources."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fixtures import World, make_world


@pytest.fixture(scope="session")
def world() -> World:
    return make_world()
