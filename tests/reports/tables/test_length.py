import pytest
from made_up import builder, of_experiment, run_set

from padgs.reports.methods import title

length = builder("length")

FINAL = {"omnigs": 27.0, "odgs": 28.0, "spags": 29.0, "op43dgs": 26.0}
SHORT = {"omnigs": 24.0, "odgs": 23.0, "spags": 22.0, "op43dgs": 25.0}  # the reverse
MIDDLE = {"omnigs": 24.0, "odgs": 25.0, "spags": 26.0, "op43dgs": 23.95}


def runs():
    orders = {("published", 500): SHORT, ("published", 1500): MIDDLE, ("published", 7000): FINAL, ("run", 500): MIDDLE}
    return [
        of_experiment("length", psnr + off, preset=preset, iterations=n, seed=seed, train={"learning_rates": rates})
        for (rates, n), order in orders.items()
        for preset, psnr in order.items()
        for seed, off in enumerate((-0.02, 0.02))
    ]


def test_a_column_for_each_length_and_choice_of_rates_and_the_order_beside_that_of_the_longest():
    table = length(run_set(runs()))
    titles = [column.title for column in table.columns]
    assert titles[0] == "500 iterations, published rates" and titles[3] == "500 iterations, rates for the run"
    methods, correlation = table.blocks
    assert {row.title: row.cells[0].value for row in methods.rows}[title("odgs")] == pytest.approx(22.6)
    assert [cell.value for cell in correlation.rows[0].cells] == pytest.approx([-1, 1, 1, 1])


def test_the_least_length_that_has_the_order_of_the_longest():
    notes = "\n".join(length(run_set(runs())).notes)
    assert "published rates: from 1500 iterations on" in notes and "rates for the run: from 500 iterations on" in notes
    assert "published rates: from 7000 iterations on" in "\n".join(
        length(run_set([run for run in runs() if run.iterations != 1500])).notes
    )


def test_runs_from_before_there_was_a_choice_have_the_published_rates():
    old = [of_experiment("length", psnr, preset=preset) for preset, psnr in FINAL.items()]
    assert [column.title for column in length(run_set(old)).columns] == ["1500 iterations, published rates"]
    assert length(run_set([])).blocks == ()
