import math

import pytest

from padgs.learning.schedule import Constant, LogLinear, scaled


def test_log_linear_falls_by_equal_factors():
    decay = LogLinear(1e-2, 1e-4, steps=30_000)
    assert decay(0) == pytest.approx(1e-2)
    assert decay(15_000) == pytest.approx(1e-3)
    assert decay(30_000) == pytest.approx(1e-4)
    factors = [decay(i + 1000) / decay(i) for i in range(0, 30_000, 1000)]
    assert factors == pytest.approx([factors[0]] * 30)


def test_log_linear_stays_at_its_end():
    assert LogLinear(1e-2, 1e-4, steps=10)(1_000_000) == pytest.approx(1e-4)


def test_constant_is_constant():
    assert {Constant(0.3)(i) for i in (0, 1, 10**6)} == {0.3}


@pytest.mark.parametrize("start, end, steps", [(0.0, 1e-3, 10), (1e-3, 0.0, 10), (1e-3, 1e-4, 0), (math.nan, 1.0, 3)])
def test_rates_without_a_logarithm_are_refused(start, end, steps):
    with pytest.raises(ValueError, match="both rates must be > 0"):
        LogLinear(start, end, steps)


def test_windows_follow_the_run_length():
    assert [scaled(n, 3_000) for n in (100, 500, 1500, 15_000)] == [10, 50, 150, 1500]
    assert scaled(100, 30) == 1
