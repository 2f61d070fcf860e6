"""Which methods are ranked: those that saw half as many training pixels as another, or trained for a time."""

from dataclasses import replace

import pytest
from support.made_up import builder, of_experiment, run_set, small, value

from padgs.reports.charts.trade_off import trade_offs
from padgs.reports.charts.trade_off_chart import draw
from padgs.reports.conditions import unranked
from padgs.reports.methods import title
from padgs.reports.significance import BEST, SECOND, emphasis
from padgs.reports.writers import markdown

table1, table4, methods, order = map(builder, ("table1", "table4", "methods", "order"))
ROOM, PIXELS, ITERATIONS = "synthetic-room", 512 * 256, 1500
FEW = "EgoNeRF, small"


def ad_hoc(psnr: dict[str, float], share: float, seconds: float | None = None, **others) -> list:
    """Three runs without an experiment of each preset; EgoNeRF sees a share of the pixels of the others."""
    made = []
    for place, (preset, quality) in enumerate(psnr.items()):
        options = {"rays": share * PIXELS} if preset.startswith("egonerf") else {}
        config = {"train": {"iterations": ITERATIONS}, "method": options}
        config |= {"budget": {"seconds": seconds, "clock": "cpu"}} if seconds else {}
        own = {"preset": preset, "method": preset.partition("_")[0], "config": config, **others}
        for seed in range(3):
            one = small(quality + 0.1 * seed, 1.0 + place, seed=seed, **own)
            made.append(replace(one, config={**config, "seed": seed}))
    return made


def bests(table, column: str, block: str = ROOM) -> dict[str, str]:
    """Row of a block -> its mark in a column."""
    found = next(b for b in table.blocks if b.title.startswith(block))
    (index,) = (n for n, of in enumerate(table.columns) if column in (of.title, of.group))
    return {found.rows[row].title: mark for row, mark in emphasis(found, index, table.columns).items()}


PSNR = {"egonerf_small": 30.0, "padgs": 26.0, "omnigs": 24.0}


def test_less_than_half_of_the_images_is_too_few_unless_the_runs_are_of_a_time():
    for share, words in ((0.5, None), (0.499, "748 of 1500 images"), (0.01, "15 of 1500 images")):
        found = unranked(run_set(ad_hoc(PSNR, share)).runs)
        assert {of: numbers for of, (_, numbers) in found.items()} == ({"egonerf_small": words} if words else {})
        assert unranked(run_set(ad_hoc(PSNR, share, seconds=60.0)).runs) == {}


def test_runs_of_a_time_without_an_experiment_are_ranked_whatever_they_saw():
    timed, counted = (run_set(ad_hoc(PSNR, 0.01, seconds)) for seconds in (60.0, None))
    for build in (table1, methods):
        assert bests(build(timed), "PSNR") == {FEW: BEST, "PaD-GS": SECOND}, "60 s of CPU time for each"
        assert "Not ranked" not in markdown(build(timed)) and f"| {FEW} (n=3) |" in markdown(build(timed))
        assert bests(build(counted), "PSNR") == {"PaD-GS": BEST, "OmniGS, corrected": SECOND}
        assert f"| {FEW} † (n=3) |" in markdown(build(counted))
    assert bests(table4(timed), "ms per frame") == {FEW: BEST, "PaD-GS": SECOND}
    assert bests(table4(counted), "ms per frame") == {"PaD-GS": BEST, "OmniGS, corrected": SECOND}


def test_means_over_scenes_of_a_time_are_ranked_whatever_was_seen():
    for seconds, best in ((60.0, FEW), (None, "PaD-GS")):
        made = []
        for scene, more in (("attic", 0.0), ("hall", 4.0)):
            psnr = {preset: of + more for preset, of in PSNR.items()}
            runs = ad_hoc(psnr, 0.01, seconds, scene=scene, dataset="")
            made += [replace(run, run=f"{scene}{run.run}") for run in runs]
        table = table1(run_set(made))
        mean = table.blocks[0].title
        assert mean == "Average over 2 scenes: attic, hall"
        assert value(table, mean, "PaD-GS", "PSNR") == pytest.approx((26.1 + 30.1) / 2)
        assert bests(table, "PSNR", mean)[best] == BEST and (FEW in bests(table, "PSNR", mean)) == bool(seconds)


def test_the_front_of_a_chart_has_what_saw_few_images_only_after_equal_time():
    for seconds, first in ((60.0, "egonerf_small"), (None, "padgs")):  # the best and cheapest of those ranked
        (made,) = trade_offs(run_set(ad_hoc(PSNR, 0.01, seconds)))
        for panel, marks, _, _ in draw(made)[1]:
            at = {mark.point.preset: mark.x for mark in marks}
            assert len(at) == 3 and panel.lines[0].get_xydata()[0, 0] == at[first]


def ordered(*seeds: int, share: float = 0.01) -> list:
    """Three runs of two methods in `order`, and seeds of EgoNeRF, the best, with a share of their pixels."""
    every = {"egonerf_small": seeds, "padgs": range(3), "omnigs": range(3)}
    return [
        of_experiment(
            "order@cpu",
            PSNR[preset] + 0.1 * seed,
            preset=preset,
            seed=seed,
            options={"rays": share * PIXELS} if preset == "egonerf_small" else {},
        )
        for preset, own in every.items()
        for seed in own
    ]


@pytest.mark.parametrize("seeds", [(0,), (0, 1, 2)])
def test_in_the_order_of_quality_what_saw_few_images_has_no_rank_and_takes_none_away(seeds):
    table = order(run_set(ordered(*seeds)))
    (block,) = table.blocks
    ranks = [(row.title, row.cells[0].value) for row in block.rows]
    assert ranks == [(title("egonerf_small"), None), (title("padgs"), 1), (title("omnigs"), 2)]
    assert value(table, block.title, title("egonerf_small"), "PSNR") == pytest.approx(30 + 0.1 * (len(seeds) // 2))
    assert bests(table, "WS-PSNR", block.title) == {title("padgs"): BEST, title("omnigs"): SECOND}
    text = markdown(table)
    assert f"| {FEW} †{' (n=3)' if seeds[1:] else ''} |" in text and "| PaD-GS (n=3) |" in text
    assert "- † Not ranked: EgoNeRF, small (15 of 1500 images): for it saw less than half" in text
    (enough,) = order(run_set(ordered(0, 1, 2, share=0.5))).blocks
    assert [row.cells[0].value for row in enough.rows] == [1, 2, 3]
