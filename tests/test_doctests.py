"""Examples in docstrings."""

import doctest
from importlib import import_module

import pytest
from test_layers import SOURCES


@pytest.mark.parametrize("name", sorted(name for name, path in SOURCES.items() if ">>> " in path.read_text()))
def test_examples_in_docstrings_hold(name):
    assert doctest.testmod(import_module(name)).failed == 0
