from dataclasses import replace

import pytest
from made_up import RULES, builder, of_experiment, run_set

from padgs.reports.specs import EFFECTS
from padgs.reports.writers import csv_rows, latex, markdown
from padgs.results import Scores

modulation = builder("modulation")

VOXEL, TAU, BOTH = 2.0, -2.6, 0.3  # dB


def runs(seeds=(0.0, 0.1)):
    return [
        of_experiment(
            "modulation@cpu",
            26 + off + VOXEL * paper + (TAU + seed * 0.2) * dimmed + BOTH * paper * dimmed,
            preset="padgs" if paper else "padgs_small",
            options={"tau": 0.9 * dimmed},
            seed=seed,
        )
        for paper in (0, 1)
        for dimmed in (0, 1)
        for seed, off in enumerate(seeds)
    ]


def values(table, column: str) -> dict[str, tuple[float | None, float | None]]:
    index = [c.title for c in table.columns].index(column)
    cells = {row.title: row.cells[index] for block in table.blocks for row in block.rows}
    return {title: (cell.value, cell.std) for title, cell in cells.items()}


def test_effects_are_those_that_were_put_in_whatever_the_seed_adds():
    found = values(modulation(run_set(runs())), "WS-PSNR")
    assert found["one anchor per 3 px, τ = 0"] == pytest.approx((25.65, 0.0707), abs=1e-4)
    voxel, tau, both = (found[title] for title in EFFECTS)
    assert voxel == pytest.approx((VOXEL + BOTH / 2, 0)) and both == pytest.approx((BOTH, 0))
    assert tau == pytest.approx((TAU + 0.1 + BOTH / 2, 0.2 / 2**0.5))


def test_effects_have_their_sign_and_none_is_the_best():
    table = modulation(run_set(runs()))
    effects = markdown(table).split("### Effects")[1].split("\n- ")[0]
    assert "+2.15" in effects and "**" not in effects and "↑" not in effects and "<ins>" not in effects
    assert r"$\tau$ = 0.9 instead of 0" in latex(table)
    numbers = csv_rows(table)
    assert set(numbers.loc[numbers["row"].isin(EFFECTS), "rank"]) == {""} != set(numbers["rank"])


def test_a_run_that_was_stopped_is_no_seed():
    stopped = replace(runs()[0], run="stopped", seed=9, variant="stopped after 9 iterations")
    assert modulation(run_set([*runs(), stopped])) == modulation(run_set(runs()))


def test_a_missing_setting_has_no_effect_and_the_paper_may_score_without_the_bottom():
    marks = {"psnr": 30.0}
    made = [
        replace(run, scores={**run.scores, "paper": Scores(RULES | {"bottom_crop": 0.0635}, marks, {})})
        for run in runs()
    ]
    table = modulation(run_set(made))
    assert values(table, "PSNR by the paper's protocol")["one anchor per 0.1 px, τ = 0.9"][0] == 30
    assert values(table, "PSNR")["one anchor per 0.1 px, τ = 0.9"][0] != 30
    assert "without the last 6.3 % of the rows" in "".join(table.notes)
    found = values(modulation(run_set(runs()[2:])), "PSNR")
    assert [found[title][0] for title in EFFECTS] == [None] * 3
    assert modulation(run_set([])).blocks == ()
