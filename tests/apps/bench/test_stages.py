"""The clock of stages on made-up times, and the profiler."""

from types import SimpleNamespace

import pytest
import torch

from padgs.apps.bench import stages
from padgs.apps.bench.stages import STAGES, StageClock
from padgs.apps.bench.workload import Size, build
from padgs.native import cpu
from padgs.native.loading import Library, call_hook


@pytest.fixture
def tick(monkeypatch):
    """Advance the wall clock by some seconds, and the CPU clock by twice as many."""
    now = [0.0]
    fake = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: 2 * now[0])
    monkeypatch.setattr(stages, "time", fake)

    def advance(seconds):
        now[0] += seconds

    return advance


def test_an_inner_stage_is_not_charged_to_the_outer_one_and_errors_end_a_stage(tick):
    clock = StageClock()
    tick(100)
    with clock.stage("backward"):
        tick(1)
        with clock.stage("blend_backward"):
            tick(10)
        tick(2)
        with clock.stage("blend_backward"):
            tick(20)
    tick(1000)  # in no stage
    with pytest.raises(ZeroDivisionError), clock.stage("loss"):
        tick(1)
        raise ZeroDivisionError
    with clock.stage("optimizer"):
        tick(4)
    clock.finish_round()
    assert clock.rounds == [{"backward": (3, 6), "blend_backward": (30, 60), "loss": (1, 2), "optimizer": (4, 8)}]


def test_the_least_time_of_all_iterations_counts(tick):
    clock = StageClock()
    for seconds in (2, 1, 5):
        with clock.stage("loss"):
            tick(seconds)
        clock.finish_round()
    assert clock.stages() == {"loss": {"seconds": 2, "wall": 1}}


def test_native_calls_are_charged_to_their_stages(tick):
    library = Library(SimpleNamespace(padgs_bin=lambda x: (tick(3), x)[1], padgs_isa=lambda: b"none"))
    clock = StageClock()
    with call_hook(clock.native_call), clock.stage("draw"):
        assert library.padgs_bin(7) == 7
        assert library.padgs_isa() == b"none"
    library.padgs_bin(7)  # outside of the hook
    clock.finish_round()
    assert clock.rounds == [{"draw": (0, 0), "sort": (3, 6)}]


def test_hooked_calls_exist_and_belong_to_a_stage():
    if not cpu.available():
        pytest.skip("the native library is not built")
    for name, stage in stages.NATIVE_CALLS.items():
        assert stage in STAGES
        assert hasattr(cpu.library(), name)


def test_names_of_kernels_are_without_types_and_arguments():
    blend = "void padgs::(anonymous namespace)::blend_kernel<16, true>(Arguments)"
    assert [*map(stages.kernel_name, (blend, "Memcpy HtoD (Pinned -> Device)"))] == [
        "padgs::blend_kernel",
        "Memcpy HtoD",
    ]


def test_the_profiler_lists_kernels_of_an_iteration_slowest_first():
    found = stages.device_stages(build(Size(32, 16, 50)), 2, torch.device("cpu"))  # operators in place of kernels
    seconds = [entry["seconds"] for entry in found.values()]
    assert "aten::mul" in found and found["aten::mul"]["calls"] >= 1
    assert seconds == sorted(seconds, reverse=True) and seconds[0] > 0
