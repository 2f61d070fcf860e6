"""Budgets of Gaussians, for all methods that have some."""

import pytest
from support.tiny_scene import tiny_scene

from padgs.baselines import METHODS
from padgs.multirun.composition import make_method
from padgs.registry import lookup
from padgs.training.options import Budget


@pytest.mark.parametrize("name", ["omnigs", "spags", "cubemap_3dgs"])
def test_budget_auto_prunes_once_after_densification(name):
    method = lookup(METHODS, name, "method")()
    counts, events = [], []
    for record in method.fit(tiny_scene(), Budget(120, gaussians="auto")):
        counts.append(record.counts["gaussians"])
        events += [(record.iteration, event) for event in record.events if "least important" in event]
    ((iteration, event),) = events
    assert iteration == method.model.densifier.options.densify_until + 49
    before, after = counts[iteration - 2], counts[iteration - 1]
    assert event == f"pruned the least important of {before} Gaussians, kept {after}"
    assert after < before


def test_budget_auto_is_refused_if_cameras_are_learned():
    with pytest.raises(ValueError, match="budget.gaussians is auto.*set it to a number or null"):
        lookup(METHODS, "sc_omnigs", "method")().refuse_budget(Budget(120, gaussians="auto"))


def test_budget_auto_works_with_learned_exposures():
    method = make_method("omnigs", "train.exposures=learned")
    method.refuse_budget(Budget(120, gaussians="auto"))
    with pytest.raises(ValueError, match="budget.stop is auto"):
        method.refuse_budget(Budget(120, stop="auto"))
