import math
from dataclasses import replace

import pytest

from padgs.training.schedule import FASTEST, PUBLISHED_ITERATIONS, Constant, LogLinear, Pace, ParameterGroup, scaled


def test_log_linear_falls_by_equal_factors_and_stays_at_its_end():
    decay = LogLinear(1e-2, 1e-4, steps=30_000)
    assert [decay(i) for i in (0, 15_000, 30_000, 10**6)] == pytest.approx([1e-2, 1e-3, 1e-4, 1e-4])
    factors = [decay(i + 1000) / decay(i) for i in range(0, 30_000, 1000)]
    assert factors == pytest.approx([factors[0]] * 30)
    assert {Constant(0.3)(i) for i in (0, 1, 10**6)} == {0.3}


@pytest.mark.parametrize("start, end, steps", [(0.0, 1e-3, 10), (1e-3, 0.0, 10), (1e-3, 1e-4, 0), (math.nan, 1.0, 3)])
def test_rates_without_a_logarithm_are_refused(start, end, steps):
    with pytest.raises(ValueError, match="both rates must be > 0"):
        LogLinear(start, end, steps)


@pytest.mark.parametrize("choice", ["published", "run", 1])
def test_the_published_run_has_published_rates_to_the_last_bit(choice):
    pace = Pace.of(choice, PUBLISHED_ITERATIONS)
    assert {pace(iteration) for iteration in range(1, PUBLISHED_ITERATIONS + 1)} == {1.0}


@pytest.mark.parametrize("iterations", [1, 60, 468, 469, 7000, 29_999, 30_001, 10**6])
def test_rates_of_a_run_follow_the_square_root_of_what_it_is_shorter(iterations):
    pace = Pace.of("run", iterations)
    assert pace.factor == pytest.approx(max(1.0, min(FASTEST, (PUBLISHED_ITERATIONS / iterations) ** 0.5)))
    assert pace(round(0.5 * iterations)) == pace.factor or iterations == 1
    assert pace(iterations) == 1.0


def test_faster_rates_fade_by_equal_factors_at_the_end():
    pace = Pace.of(8.0, 1000)
    assert [pace(i) for i in (1, 599, 600)] == [8.0] * 3
    factors = [pace(i + 50) / pace(i) for i in range(600, 1000, 50)]
    assert factors == pytest.approx([8.0 ** (-1 / 8)] * 8)


def test_a_group_begins_with_its_least_pace_where_the_pace_follows_from_the_length():
    group = ParameterGroup("means", (), Constant(0.1), least_pace=5.0)
    for iterations, factor in ((700, (30_000 / 700) ** 0.5), (1200, 5.0), (7000, 5.0), (30_000, 5.0)):
        pace = Pace.of("run", iterations)
        rates = [group.rate(round(t * iterations), pace) for t in (0, 0.6, 0.8, 1)]
        assert rates == pytest.approx([0.1 * f for f in (factor, factor, factor**0.5, 1)])
    assert group.rate(1, Pace.of("published", 7000)) == group.rate(1, None) == 0.1
    assert group.rate(1, Pace.of(2.0, 7000)) == pytest.approx(0.2)
    assert replace(group, paced=False).rate(1, Pace.of("run", 7000)) == 0.1


def test_windows_follow_the_run_length():
    assert [scaled(n, 3_000) for n in (100, 500, 1500, 15_000)] == [10, 50, 150, 1500]
    assert scaled(100, 30) == 1
