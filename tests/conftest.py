"""Fixtures that every test may use. Data that is not part of the project is found beside the repository."""

import signal
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# Generated examples are the same on every machine, and a slow machine is not a failure.
settings.register_profile("padgs", deadline=None, derandomize=True)
settings.load_profile("padgs")

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"


@pytest.fixture(scope="session", autouse=True)
def ctrl_c() -> None:
    """Shells have what they start in the background ignore Ctrl-C, and tests of it would wait for it in vain."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def root() -> Path:
    """The root of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of golden cases, fixtures and real panoramas; the test is skipped where there is none."""
    if not SHARED.is_dir():
        pytest.skip(f"no golden cases, fixtures or data: {SHARED} is not there")
    return SHARED


@pytest.fixture
def generator() -> torch.Generator:
    """A seeded source of random numbers, the same for every test."""
    return torch.Generator().manual_seed(2025)
