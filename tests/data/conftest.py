"""The tiny world, once for all tests of data sources."""

import pytest
from support.fixtures import World, make_world


@pytest.fixture(scope="session")
def world() -> World:
    return make_world()
