"""The table and the chart of what `padgs need` found, on searches that are made up."""

from dataclasses import replace

import pytest
from made_up import run_set, small
from PIL import Image

from padgs.reports.charts.smallest_chart import charts
from padgs.reports.smallest import curves, gain, ratio, searched
from padgs.reports.smallest import table as need
from padgs.reports.table import ReportError
from padgs.reports.writers import markdown

SIZES = (8000, 4000, 2000, 1000)


def found(best: float, *, rows: str = "gaussians", each: int = 1) -> dict:
    """A search: quality falls by 0.05 dB, 0.15 and 0.45 with each halving; the need for 0.1 dB is 4000."""
    lost = (0.0, 0.05, 0.2, 0.65)
    steps = [
        {
            "kind": kind,
            "parent": None,
            "depth": depth,
            "rows": size // each,
            "blended": size,
            "bytes": 100 * size,
            "frame_ms": size / 1000,
            "seconds": 2.0,
            "cpu_seconds": 1.0,
            "loss": loss,
            "ws_psnr": best + 1 - loss,
            "lpips": None,
            "test_ws_psnr": best - loss,
            "objections": {},
        }
        for kind, depth, size, loss in [
            ("waste", 0, SIZES[0], lost[0]),
            ("control", 1, SIZES[0], 0.0),
            *(("prune", 1, SIZES[n], lost[n]) for n in (1, 2, 3)),
        ]
    ]
    needs = {"0.05": 0, "0.1": 2, "0.25": 3, "0.5": 3, "1": 4}
    own = {"row": rows, "rows": 10_000 // each, "waste": 2000 // each, "needs": needs, "knee": 2, "steps": steps}
    return own | {"calibration": ["a", "b", "c"], "seconds": 10.0, "cpu_seconds": 5.0}


def runs() -> list:
    made = [
        small(30.0, method=method, experiments=("need",), need=found(best, each=each))
        for method, best, each in (("omnigs", 30.0, 1), ("padgs", 29.0, 10))
    ]
    return [*made, small(31.0, method="odgs")]


def test_a_row_for_each_search_with_its_needs():
    text = markdown(need(run_set(runs())))
    row = next(line for line in text.splitlines() if line.startswith("| OmniGS"))
    assert [cell.strip("* ") for cell in row.split("|")][2:8] == ["8000", *("8000", "4000", "2000", "2000", "1000")][:6]
    assert "| 0.40 |" in row and "ODGS" not in text
    assert need(run_set(runs()[2:])).blocks == () and charts(run_set(runs()[2:])) == []


def test_seeds_of_a_method_share_a_row_and_an_entry_of_the_legend():
    again = [replace(one, seed=1, run=f"{one.run}_1") for one in runs()[:2]]
    sizes = again[1].need["steps"][0] | {"blended": 6000}
    again[1] = replace(again[1], need=again[1].need | {"steps": [sizes, *again[1].need["steps"][1:]]})
    seeds = run_set([*runs(), *again])
    (block,) = need(seeds).blocks
    columns = need(seeds).columns
    texts = {row.title: row.texts(columns)[:2] for row in block.rows}
    assert list(texts.values()) == [["OmniGS, corrected (n=2)", "8000 ± 0"], ["PaD-GS (n=2)", "7000 ± 1414"]]
    first, *_ = charts(seeds)
    assert first.numbers is not None and first.numbers["curve"].nunique() == 4
    assert "thin: further seeds" in first.svg and first.svg.count(">PaD-GS</") == 1


def kept(loss: str, degree: int | None = None, tau: float = 0.9, seed: int = 0):
    """A run that `padgs need` left of another that has four degrees of harmonics."""
    more = {"kept": {"epsilon": float(loss), "degree": degree}, "degrees": {loss: [{"degree": 3, "objections": {}}]}}
    more["files"] = [{"file": "a", "bytes": 5, "kept": True}]
    method = {"tau": tau, "sh_degree": 3 if degree is None else degree}
    variant, run = f"need {loss} dB", f"room_{tau}_{seed}_need-{loss}"
    config = {"method": method, "seed": seed, "variant": variant}
    return replace(small(30.0, run=run, seed=seed, config=config, need=found(30.0) | more), variant=variant)


def test_a_search_has_one_row_whatever_it_kept_and_rows_have_names_of_their_own():
    other, stated = kept("1"), kept("0.1", degree=1)
    (curve,) = curves(searched(run_set([other, stated])))
    assert curve.title == "PaD-GS" and curve.file is not None
    assert len(curves(searched(run_set([other])))) == 1
    seeds = [curve.title for curve in curves(searched(run_set([kept("0.1", seed=1), stated])))]
    assert seeds == ["PaD-GS, seed 0", "PaD-GS, seed 1"]
    settings = [curve.title for curve in curves(searched(run_set([stated, kept("1", tau=0.0), other])))]
    assert settings == ["PaD-GS, tau 0.0", "PaD-GS, tau 0.9"]


def test_a_share_has_no_better_end_and_times_of_two_machines_are_not_compared():
    assert "share for 0.1 dB" in [column.heading for column in need(run_set(runs())).columns]
    first, second, _ = runs()
    elsewhere = run_set([first, replace(second, machine={"gpu": "H200"})])
    for build in (need, charts):
        with pytest.raises(ReportError, match="differ in machine"):
            build(elsewhere)


def test_curves_are_compared_where_both_are():
    ours, other = curves(searched(run_set(runs())))
    assert gain(ours, other) == pytest.approx(1.0) and gain(ours, ours) == 0
    assert ratio(ours, ours) == 1 and ratio(ours, other) is None, "they share no quality"
    halved = [small(30.0, method="odgs", need=found(30.0)), small(30.0, method="omnigs", need=found(30.0))]
    for step in halved[0].need["steps"]:
        step["blended"] //= 2
    first, second = curves(searched(run_set(halved)))
    assert {first.preset: ratio(first, second), second.preset: ratio(second, first)} == pytest.approx(
        {"odgs": 0.5, "omnigs": 2.0}
    )


def test_the_chart_has_a_point_for_each_size_and_all_numbers():
    (chart,) = charts(run_set(runs()))
    assert chart.name == "smallest_synthetic-room_512x256_1500-iterations" and chart.png.startswith(b"\x89PNG")
    assert chart.numbers is not None and len(chart.numbers) == 2 * len(SIZES)
    assert list(chart.numbers["smallest for"])[:4] == ["0.05", "0.1", "0.25 0.5", "1"]
    assert "4000 Gaussians" in chart.svg and "lost 0.65 dB" in chart.svg


def test_charts_of_scenes_of_two_data_sets_have_names_of_their_own():
    datasets = ("", "omniblender")
    made = [small(30.0, scene="room", dataset=one, run=f"of-{one}", need=found(30.0)) for one in datasets]
    names = [chart.name for chart in charts(run_set(made))]
    assert names == ["smallest_room_512x256_1500-iterations", "smallest_room_omniblender_512x256_1500-iterations"]


def test_a_test_view_is_shown_at_each_size_where_there_is_a_picture_of_it(tmp_path):
    found = run_set(runs())
    assert len(charts(found)) == 1
    Image.new("RGB", (4 * 32, 16), "red").save(tmp_path / "need.png")
    found.runs["pictures"] = [tmp_path / "renders"] * len(found.runs)
    _, pictures = charts(found)
    assert pictures.name.endswith("_renders") and "all: 8000 Gaussians" in pictures.svg
    assert "0.1 dB: 4000" in pictures.svg and "1 dB: 1000" in pictures.svg


def test_degree_and_file_are_those_for_a_tenth_of_a_decibel():
    (old,) = curves(searched(run_set(runs()[:1])))
    assert old.degree is None and old.file is None
    steps = [{"degree": 2, "objections": {"0.1": []}}, {"degree": 1, "objections": {"0.1": ["a view falls"]}}]
    files = [{"file": "a", "bytes": 5, "kept": False}, {"file": "b", "bytes": 4, "kept": True}]
    run = runs()[0]
    more = {"degrees": {"0.1": steps}, "kept": {"epsilon": 0.1}, "files": files}
    (curve,) = curves(searched(run_set([replace(run, need=run.need | more)])))
    assert curve.degree == 2 and curve.file == files[1]
