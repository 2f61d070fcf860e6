"""The clock that takes an iteration apart, on made-up times."""

from types import SimpleNamespace

import pytest

from padgs.apps.bench import stages
from padgs.apps.bench.stages import STAGES, StageClock, amortised
from padgs.native import cpu
from padgs.native.loading import Library, call_hook


@pytest.fixture
def tick(monkeypatch):
    """Advance both clocks: wall by what is asked for, CPU by twice that."""
    now = [0.0]
    fake = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: 2 * now[0])
    monkeypatch.setattr(stages, "time", fake)

    def advance(seconds):
        now[0] += seconds

    return advance


def test_an_inner_stage_is_not_charged_to_the_outer_one(tick):
    clock = StageClock()
    tick(100)
    with clock.stage("backward"):
        tick(1)
        with clock.stage("blend_backward"):
            tick(10)
        tick(2)
        with clock.stage("blend_backward"):
            tick(20)
    tick(1000)  # nobody's
    with clock.stage("optimiser"):
        tick(4)
    clock.finish_round()
    assert clock.rounds == [{"backward": (3, 6), "blend_backward": (30, 60), "optimiser": (4, 8)}]
    assert clock.total()["wall"]["median"] == 37


def test_rounds_are_summed_up_apart(tick):
    clock = StageClock()
    for seconds in (1, 5, 2):
        with clock.stage("loss"):
            tick(seconds)
        clock.finish_round()
    assert clock.stages()["loss"]["wall"] == {"median": 2, "p95": 5, "min": 1}
    assert clock.stages()["loss"]["cpu"]["min"] == 2


def test_a_stage_that_fails_is_left(tick):
    clock = StageClock()
    with pytest.raises(ZeroDivisionError), clock.stage("loss"):
        tick(1)
        raise ZeroDivisionError
    with clock.stage("decode"):
        tick(2)
    clock.finish_round()
    assert clock.rounds == [{"loss": (1, 2), "decode": (2, 4)}]


def test_native_calls_are_charged_to_their_stages(tick):
    library = Library(SimpleNamespace(padgs_bin=lambda x: (tick(3), x)[1], padgs_isa=lambda: b"none"))
    clock = StageClock()
    with call_hook(clock.native_call), clock.stage("draw"):
        assert library.padgs_bin(7) == 7
        assert library.padgs_isa() == b"none"
    library.padgs_bin(7)  # nobody watches any more
    clock.finish_round()
    assert clock.rounds == [{"draw": (0, 0), "sort": (3, 6)}]


def test_watched_calls_exist_and_belong_to_a_stage():
    if not cpu.available():
        pytest.skip("the native library is not built")
    for name, stage in stages.NATIVE_CALLS.items():
        assert stage in STAGES
        assert hasattr(cpu.library(), name)


def test_growing_is_charged_once_in_a_hundred_iterations():
    event = {"repeats": 2, "wall": {"median": 3.0}, "cpu": {"median": 1.0}}
    assert amortised(event) == {"repeats": 2, "wall": {"median": 0.03}, "cpu": {"median": 0.01}}
