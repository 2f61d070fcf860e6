"""The examples in docstrings, which are there to be believed."""

import doctest
import pkgutil
from importlib import import_module

import pytest

import padgs

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(padgs.__path__, "padgs.")
    if not module.name.split(".")[-1].startswith("lib")  # the native libraries lie beside the modules that load them
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_come_out_as_written(name):
    assert doctest.testmod(import_module(name)).failed == 0
