"""The table and the chart of searches for smallest models, on made-up numbers."""

from dataclasses import replace

import pytest
from support.made_up import run_set, small

from padgs.reports.smallest import charts, table
from padgs.reports.table import ReportError
from padgs.reports.writers import markdown

SIZES = (8000, 4000, 2000, 1000)


def found(best: float, *, rows: str = "gaussians", each: int = 1) -> dict:
    """A search: quality falls by 0.05 dB, 0.15 and 0.45 with each halving; the smallest model for 0.1 dB has 4000."""
    lost = (0.0, 0.05, 0.2, 0.65)
    steps = [
        {
            "run": "",
            "rows": size // each,
            "blended": size,
            "bytes": 100 * size,
            "frame_ms": size / 1000,
            "seconds": 2.0,
            "cpu_seconds": 1.0,
            "loss": loss,
            "ws_psnr": best - 0.5 - loss,
            "lpips": None,
            "objections": {},
        }
        for size, loss in zip(SIZES, lost, strict=True)
    ]
    minimal = {"0.05": 0, "0.1": 1, "0.25": 2, "0.5": 2, "1": 3}
    own = {
        "row": rows,
        "possible": minimal | {"0.1": 2},
        "rows": 10_000 // each,
        "ws_psnr": best,
        "minimal": minimal,
        "steps": steps,
    }
    return own | {"views": ["a", "b", "c"], "seconds": 10.0, "cpu_seconds": 5.0}


def runs() -> list:
    made = [
        small(30.0, method=method, experiments=("smallest",), smallest=found(best, each=each))
        for method, best, each in (("omnigs", 30.0, 1), ("padgs", 29.0, 10))
    ]
    return [*made, small(31.0, method="odgs")]


def test_a_row_for_each_search_with_its_smallest_models():
    text = markdown(table(run_set(runs())))
    row = next(line for line in text.splitlines() if line.startswith("| OmniGS"))
    assert [cell.strip("* ") for cell in row.split("|")][2:8] == ["8000", *("8000", "4000", "2000", "2000", "1000")][:6]
    assert [cell.strip("* ") for cell in row.split("|")][8] == "2000", "interval"
    assert "| 0.40 |" in row and "ODGS" not in text
    assert table(run_set(runs()[2:])).blocks == () and charts(run_set(runs()[2:])) == []


def test_times_of_searches_on_two_machines_are_not_compared():
    first, second, _ = runs()
    elsewhere = {**first.machine, "cpu": "another"}
    moved = replace(second, smallest={**second.smallest, "machine": elsewhere})
    with pytest.raises(ReportError, match=r"differ in machine of the search \(2 cores of A .*; 2 cores of another, "):
        table(run_set([first, moved]))
    also = replace(first, smallest={**first.smallest, "machine": elsewhere})
    assert len(table(run_set([also, moved])).blocks) == 1


def test_a_search_that_lpips_did_not_decide_says_so():
    with_lpips = [{**step, "lpips": 0.1} for step in runs()[0].smallest["steps"]]
    measured = replace(runs()[0], smallest={**runs()[0].smallest, "steps": with_lpips})
    notes = table(run_set([measured, runs()[1]])).notes
    (note,) = (note for note in notes if "LPIPS was not measured" in note)
    assert note.startswith("synthetic-room") and note.endswith("PaD-GS: LPIPS was not measured, and did not decide.")


def test_the_marks_of_the_best_numbers_are_explained():
    seeds = [replace(one, seed=seed, run=f"{one.run}_{seed}") for one in runs()[:2] for seed in range(3)]
    text = markdown(table(run_set(seeds)))
    assert "| OmniGS, corrected (n=3) |" in text and "| **29.95 ± 0.00** | **30.00 ± 0.00** |" in text
    assert text.count("- Bold: best; underlined: second, by at least 3 seeds. Rows that seeds cannot separate") == 1
    assert "Bold" not in markdown(table(run_set(runs()[2:]))), "no table, no legend"


def test_seeds_of_a_method_share_a_row_and_an_entry_of_the_legend():
    again = [replace(one, seed=1, run=f"{one.run}_1") for one in runs()[:2]]
    sizes = again[1].smallest["steps"][0] | {"blended": 6000}
    again[1] = replace(again[1], smallest=again[1].smallest | {"steps": [sizes, *again[1].smallest["steps"][1:]]})
    seeds = run_set([*runs(), *again])
    (block,) = table(seeds).blocks
    columns = table(seeds).columns
    texts = {row.title: row.texts(columns)[:2] for row in block.rows}
    assert list(texts.values()) == [["OmniGS, corrected (n=2)", "8000 ± 0"], ["PaD-GS (n=2)", "7000 ± 1414"]]
    first, *_ = charts(seeds)
    assert first.numbers is not None and first.numbers["curve"].nunique() == 4
    assert "thin: further seeds" in first.svg and first.svg.count(">PaD-GS</") == 1


def test_a_share_has_no_better_end_and_times_of_two_machines_are_not_compared():
    assert "share for 0.1 dB" in [column.heading for column in table(run_set(runs())).columns]
    first, second, _ = runs()
    elsewhere = run_set([first, replace(second, machine={"gpu": "H200"})])
    for build in (table, charts):
        with pytest.raises(ReportError, match="differ in machine"):
            build(elsewhere)


def test_the_chart_has_a_point_for_each_size_and_all_numbers():
    (chart,) = charts(run_set(runs()))
    assert chart.name == "smallest_synthetic-room_512x256_1500-iterations" and chart.png.startswith(b"\x89PNG")
    assert chart.numbers is not None and len(chart.numbers) == 2 * len(SIZES)
    assert list(chart.numbers["smallest for"])[:4] == ["0.05", "0.1", "0.25 0.5", "1"]
