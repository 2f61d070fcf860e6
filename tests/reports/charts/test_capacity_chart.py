from dataclasses import replace

import numpy as np
import pytest
from support.made_up import budgets, run_set

from padgs.reports.charts.capacity_chart import charts


def test_each_method_has_a_curve_that_is_within_the_axes_even_if_it_falls():
    (made,) = charts(run_set(budgets({("omnigs", 10_000): 30.0, ("omnigs", 20_000): 20.0, ("odgs", 10_000): 31.0})))
    assert made.name == "capacity_synthetic-room_512x256_1500-iterations"
    (panel,) = made.figure.axes
    low, high = panel.get_ylim()
    (curve,) = [line.get_xydata() for line in panel.lines if len(line.get_xdata()) > 1]
    assert curve == pytest.approx(np.array([[9999.5, 29.65], [19999.5, 19.65]])) and low < 19.5 and high > 30.7
    assert {text.get_text() for text in made.figure.texts} >= {"OmniGS", "ODGS"}
    assert made.numbers.loc[made.numbers["preset"] == "omnigs", "limit"].tolist() == [10_000, 20_000]


def test_failed_runs_are_named():
    made = budgets({("omnigs", 10_000): 30.0, ("omnigs", 20_000): 31.0})
    (chart,) = charts(run_set([*made[:-1], replace(made[-1], status="oom", scores={})]))
    assert chart.notes[-1] == "Failed runs are left out: OmniGS, corrected, gaussians 20000 (OOM)."


def test_runs_with_one_limit_have_no_chart():
    assert charts(run_set(budgets({("omnigs", 10_000): 30.0, ("odgs", 10_000): 31.0}))) == []
