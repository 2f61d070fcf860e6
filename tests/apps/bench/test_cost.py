"""The cost model: the paper's numbers, and which ceiling binds."""

import pytest

from padgs.apps.bench.ceilings import Ceiling
from padgs.apps.bench.cost import Cost, add_floors, costs
from padgs.apps.bench.stages import STAGES

CEILINGS = {"fma": Ceiling(200.0, 100.0, 0.0), "triad": Ceiling(20.0, 10.0, 0.0)}


def test_decoding_costs_what_the_layers_multiply():
    found = costs(size(anchors=1000))
    assert found["decode"].operations == pytest.approx(14.1e3 * 1000, rel=0.01)  # 37 inputs, 32 hidden, 110 outputs
    assert found["decode_backward"].operations == 2 * found["decode"].operations


def size(**counters: int) -> dict:
    counters = dict.fromkeys(("anchors", "gaussians", "instances", "evaluated", "parameters"), 0) | counters
    stages = {stage: {"cpu": {"min": 40.0}} for stage in STAGES}
    return {"width": 0, "height": 0, "counters": counters, "stages": stages}


@pytest.mark.parametrize(
    ("cost", "floor"),
    [(Cost(1000, 10), (10.0, "arithmetic")), (Cost(100, 200), (20.0, "memory")), (Cost(0, 0), (0.0, "arithmetic"))],
)
def test_the_scarcer_of_the_two_binds(cost, floor):
    assert cost.floor(CEILINGS) == floor


def test_fractions_compare_the_floor_with_cpu_time():
    measured = size(parameters=100, evaluated=1)
    add_floors(measured, CEILINGS)
    optimiser = measured["stages"]["optimiser"]
    assert (optimiser["operations"], optimiser["bytes"], optimiser["bound"]) == (1200, 2800, "memory")
    assert (optimiser["floor"], optimiser["fraction"]) == (280, 7)
    assert "fraction" not in measured["stages"]["rest"]
    assert measured["floor"] == pytest.approx(280 + 2 * (28 + 63) / 100)
