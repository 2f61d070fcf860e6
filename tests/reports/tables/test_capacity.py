"""Methods with equal numbers of Gaussians."""

from dataclasses import replace

import pytest
from made_up import builder, of_experiment, run_set

capacity = builder("capacity")


PSNR = {("omnigs", 20_000): 24.0, ("omnigs", 50_000): 26.0, ("odgs", 20_000): 25.0, ("odgs", 50_000): 25.5}


def runs():
    made = []
    for (preset, count), psnr in PSNR.items():
        for seed in (0, 1):
            one = of_experiment("capacity", psnr + 0.1 * seed, preset=preset, seed=seed)
            config = {**one.config, "budget": {"gaussians": count}}
            made.append(replace(one, run=f"{one.run}_{count}", config=config, counts={"gaussians": count - seed}))
    return made


def test_a_block_for_each_number_of_gaussians_the_fewest_first():
    fewest, most = capacity(run_set(runs())).blocks
    assert fewest.title.endswith("at most 20 000 Gaussians") and most.title.endswith("at most 50 000 Gaussians")
    for block, count in ((fewest, 20_000), (most, 50_000)):
        columns = [column.title for column in capacity(run_set(runs())).columns]
        for row, preset in zip(block.rows, ("odgs", "omnigs"), strict=True):
            assert row.cells[columns.index("PSNR")].value == pytest.approx(PSNR[preset, count] + 0.05)
            assert row.cells[columns.index("Gaussians")].value == count - 0.5


def test_runs_without_a_number_and_those_that_were_stopped_are_left_out():
    odd = of_experiment("capacity", 30.0)
    odd = [
        replace(odd, run=f"{asked}", config={**odd.config, "budget": {"gaussians": asked}}) for asked in ("auto", None)
    ]
    stopped = replace(runs()[0], run="stopped", seed=9, variant="stopped after 9 iterations")
    assert capacity(run_set([*runs(), *odd, stopped])) == capacity(run_set(runs()))


def test_nothing_was_run():
    assert not capacity(run_set([of_experiment("order", 20.0)])).blocks
