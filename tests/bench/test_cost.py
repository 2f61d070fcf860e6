"""The cost model: the paper's numbers, and which ceiling binds."""

import pytest

from padgs.anchors.model import PaDGSOptions
from padgs.bench.ceilings import Ceiling
from padgs.bench.cost import Cost, add_floors, costs

CEILINGS = {"fma": Ceiling(200.0, 100.0, 0.0), "triad": Ceiling(20.0, 10.0, 0.0)}


def test_decoding_costs_what_the_layers_multiply():
    counts = {"anchors": 1000, "gaussians": 0, "instances": 0, "evaluated": 0, "pixels": 0, "parameters": 0}
    found = costs(**counts, model=PaDGSOptions())
    assert found["decode"].operations == pytest.approx(14.1e3 * 1000, rel=0.01)  # 37 inputs, 32 hidden, 110 outputs
    assert found["decode_backward"].operations == 2 * found["decode"].operations


@pytest.mark.parametrize(
    ("cost", "floor"),
    [(Cost(1000, 10), (10.0, "arithmetic")), (Cost(100, 200), (20.0, "memory")), (Cost(0, 0), (0.0, "arithmetic"))],
)
def test_the_scarcer_of_the_two_binds(cost, floor):
    assert cost.floor(CEILINGS) == floor


def test_fractions_compare_the_floor_with_cpu_time():
    stages = {"blend": {"cpu": {"min": 40.0}}, "rest": {"cpu": {"min": 1.0}}}
    add_floors(stages, {"blend": Cost(1000, 0)}, CEILINGS)
    assert stages["blend"]["fraction"] == 0.25
    assert "fraction" not in stages["rest"]
