"""Fixtures that every test may use. Data that is not part of the project is found beside the repository."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from padgs.runs import interrupt

# Generated examples are the same on every machine, and a slow machine is not a failure.
settings.register_profile("padgs", deadline=None, derandomize=True)
settings.load_profile("padgs")

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"


@pytest.fixture(scope="session", autouse=True)
def ctrl_c() -> None:
    """Signals that a shell or nohup lets its children ignore; tests of them would wait in vain."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def shared_by_workers(tmp_path_factory) -> None:
    """Name a folder of all processes of this test run."""
    base = tmp_path_factory.getbasetemp()
    os.environ["PADGS_TESTS_SHARED"] = str(base.parent if "PYTEST_XDIST_WORKER" in os.environ else base)


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """Handlers of signals, and what is known of received ones, are those of before after each test."""
    for number in interrupt.SIGNALS:
        if getattr(signal.getsignal(number), "__module__", "") == interrupt.__name__:  # left by a fixture of a file
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    before = {number: signal.getsignal(number) for number in (*interrupt.SIGNALS, signal.SIGUSR1, signal.SIGUSR2)}
    yield
    for number, handler in before.items():
        if handler is not None and signal.getsignal(number) is not handler:
            signal.signal(number, handler)
    interrupt._raised.clear()
    interrupt._received.clear()


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


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    """One folder of generated scenes for all processes."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def start(tmp_path, cache, root):
    """Start `padgs-run`, or another program, in an empty folder, in a process group of its own."""

    def started(*arguments: str, module: str = "padgs.multirun.run") -> subprocess.Popen:
        environment = os.environ | {"PYTHONPATH": str(root), "PADGS_CACHE": str(cache), "COLUMNS": "200"}
        environment.pop("PADGS_ROOT", None)
        command = [sys.executable, "-W", "ignore", "-m", module, *arguments]
        pipe = subprocess.PIPE
        return subprocess.Popen(
            command, cwd=tmp_path, env=environment, stdout=pipe, stderr=pipe, text=True, start_new_session=True
        )

    return started
