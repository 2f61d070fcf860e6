"""The emulated GPU detects planted faults."""

import ctypes
import functools
import subprocess
import sys

import pytest
import torch
from support import cuda_engine

from padgs.native.abi import Pointer

pytestmark = pytest.mark.skipif(cuda_engine.COMPILER is None, reason="no C++ compiler")
FAULTS = ("unwritten", "race", "ahead", "two barriers", "two votes", "contraction")
ALONE = """
import ctypes, sys
ctypes.CDLL(sys.argv[1]).plant(int(sys.argv[2]), (ctypes.c_float * 64)())
"""


@functools.cache
def library(*flags: str) -> ctypes.CDLL:
    return cuda_engine.compiled("planted", [cuda_engine.HERE / "planted.cpp"], *flags)


def planted(fault: str, *flags: str) -> torch.Tensor:
    """Return the output [64] of a faulty kernel of 64 threads."""
    out = torch.zeros(64)
    library(*flags).plant(FAULTS.index(fault), Pointer(out.data_ptr()))
    return out


def test_uninitialised_shared_memory_is_nan():
    assert planted("unwritten").isnan().all()


def test_some_schedule_exposes_a_race(monkeypatch: pytest.MonkeyPatch):
    outcomes = [planted("race").tolist()]
    for seed in range(3):
        monkeypatch.setenv("PADGS_EMULATION_SEED", str(seed))
        outcomes.append(planted("race").tolist())
    assert outcomes[0] == [1.0] * 64 and all(outcome != outcomes[0] for outcome in outcomes[1:])
    monkeypatch.setenv("PADGS_EMULATION_SEED", "0")
    assert planted("race").tolist() == outcomes[1]  # a schedule can be had again


def test_some_schedule_delays_a_warp(monkeypatch: pytest.MonkeyPatch):
    assert planted("ahead").all()
    outcomes = []
    for seed in range(8):
        monkeypatch.setenv("PADGS_EMULATION_SEED", str(seed))
        outcomes.append(bool(planted("ahead").all()))
    assert {*outcomes} == {True, False}


@pytest.mark.parametrize(
    ("fault", "word"),
    [
        ("two barriers", "threads of a block wait at different barriers"),
        ("two votes", "lanes of a warp wait for different things"),
    ],
)
def test_divergent_barriers_end_the_process(fault: str, word: str):
    command = [sys.executable, "-c", ALONE, library()._name, str(FAULTS.index(fault))]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode < 0 and word in done.stderr


@pytest.mark.skipif(not cuda_engine.FUSES, reason="this CPU has no fused multiply-add")
def test_a_second_build_fuses_products_into_sums():
    assert not planted("contraction").any()
    assert planted("contraction", *cuda_engine.FUSED).any()
