import math
from dataclasses import replace

import pytest
from made_up import builder, of_experiment, run_set

from padgs.reports.frame import law
from padgs.training.schedule import Pace

learning_rates = builder("learning_rates")

FACTORS, LENGTHS = (1.0, 2.0, 4.0, 8.0), (400, 1600, 6400)


def runs(best):
    """Worse by 1 dB for each doubling away from the best factor of a length."""
    return [
        of_experiment(
            "learning_rates@cpu",
            25 - abs(math.log2(factor / best(n))) + off,
            preset="omnigs",
            iterations=n,
            seed=seed,
            train={"learning_rates": factor if factor > 1 else "published"},
        )
        for factor in FACTORS
        for n in LENGTHS
        for seed, off in enumerate((0.0, 0.1))
    ]


@pytest.mark.parametrize(
    ("best", "losses"),
    [(lambda n: min(FACTORS, key=lambda f: abs(math.log(f / law(n)))), (0, 0, 0)), (lambda n: 2, (-2, -1, 0))],
)
def test_the_law_loses_what_lies_between_its_factor_and_the_best(best, losses):
    table = learning_rates(run_set(runs(best)))
    factors, lost = table.blocks
    assert [row.title for row in factors.rows] == ["× 1", "× 2", "× 4", "× 8"]
    assert factors.rows[1].cells[0].value == pytest.approx(25 - abs(math.log2(2 / best(400))) - 0.35)
    assert [cell.value for cell in lost.rows[0].cells] == pytest.approx(losses)
    assert [cell.std for cell in lost.rows[0].cells] == pytest.approx([0, 0, 0]), "seed by seed"
    assert "× 8.00 after 400, × 4.33 after 1600, × 2.17 after 6400 iterations" in "".join(table.notes)


def test_a_run_that_was_stopped_or_failed_before_its_first_iteration_is_no_seed():
    made = runs(lambda n: 2)
    stopped = replace(made[0], run="stopped", seed=9, variant="stopped after 9 iterations")
    rates = {"train": {"learning_rates": "run"}}
    failed = replace(made[0], run="failed", iterations=0, status="oom", scores={}, config=rates)
    assert learning_rates(run_set([*made, stopped, failed])) == learning_rates(run_set(made))


@pytest.mark.parametrize("iterations", [1, 400, 1600, 6400, 30_000, 100_000])
def test_the_law_is_that_of_training(iterations):
    assert law(iterations) == Pace.of("run", iterations).factor


def test_without_runs_there_is_no_block():
    assert learning_rates(run_set([])).blocks == ()
