"""The cost model: the paper's numbers, and which ceiling binds."""

import pytest
import torch

from padgs.apps.bench.ceilings import Ceilings, add_floors, costs, device_ceilings
from padgs.apps.bench.stages import STAGES

CEILINGS = Ceilings(100.0, 10.0)


def size(**counters: int) -> dict:
    counters = dict.fromkeys(("anchors", "gaussians", "instances", "evaluated", "parameters"), 0) | counters
    return {"width": 0, "height": 0, "counters": counters, "stages": {stage: {"seconds": 40.0} for stage in STAGES}}


def test_decoding_costs_the_multiplications_of_the_layers():
    found = costs(size(anchors=1000))
    assert found["decode"][0] == pytest.approx(14.1e3 * 1000, rel=0.01)  # 37 inputs, 32 hidden, 110 outputs
    assert found["decode_backward"][0] == 2 * found["decode"][0]


def test_the_slower_of_the_two_binds():
    assert CEILINGS.floor(1000, 10) == (10.0, "arithmetic") and CEILINGS.floor(100, 200) == (20.0, "memory")
    assert Ceilings(1.0, 5.0, 0.1).best(Ceilings(2.0, 4.0, 0.3)) == Ceilings(2.0, 5.0, 0.3)


def test_floors_stand_beside_stages_with_a_cost_model_and_kernels_have_none():
    measured = size(parameters=100, evaluated=1)
    add_floors(measured, CEILINGS)
    assert measured["stages"]["optimizer"] == {"seconds": 40.0, "floor": 280, "bound": "memory"}
    assert measured["stages"]["rest"] == {"seconds": 40.0}
    assert measured["floor"] == pytest.approx(280 + 2 * (28 + 63) / 100)
    kernels = size(parameters=100, evaluated=1) | {"stages": {"blend_kernel": {"seconds": 1.0}}}
    add_floors(kernels, CEILINGS)
    assert kernels["stages"] == {"blend_kernel": {"seconds": 1.0}} and kernels["floor"] == measured["floor"]


def test_torch_measures_a_device():
    found = device_ceilings(torch.device("cpu"))
    assert found.arithmetic > 1e8 and found.memory > 1e8 and found.crowding == 0
