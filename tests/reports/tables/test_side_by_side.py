"""Tables of all methods, after equal iterations and after equal time."""

from dataclasses import replace

import pytest
from made_up import builder, compared, run_set, small

from padgs.reports.statistics import BEST, SECOND, emphasis
from padgs.reports.table import ReportError, Table
from padgs.reports.writers import markdown

equal_time = builder("equal_time")
methods = builder("methods")
table1 = builder("table1")
table4 = builder("table4")


def columns(table: Table) -> list[str]:
    return [column.title for column in table.columns]


def value(table: Table, block: str, row: str, column: str) -> float | None:
    rows = next(b.rows for b in table.blocks if b.title.startswith(block))
    return next(r for r in rows if r.title == row).cells[columns(table).index(column)].value


def ranks(table: Table, block: str) -> dict[str, set[str]]:
    """Row of a block -> the places that it takes in any column."""
    found = next(b for b in table.blocks if b.title.startswith(block))
    places = [emphasis(found, index, table.columns) for index in range(len(table.columns))]
    return {row.title: {of[number] for of in places if number in of} for number, row in enumerate(found.rows)}


def trained(method: str, seconds: float, iterations: int, psnr: float = 25.0, **others):
    budget = {"seconds": float(seconds), "clock": "cpu"}
    config = {"train": {"iterations": 30_000}, "budget": budget, "method": {"sh_degree": 3}, "seed": 0}
    own = {"method": method, "iterations": iterations, "iterations_done": iterations, "config": config}
    made = small(psnr, seconds / 100, experiments=("equal_time",), **own, **others)
    return replace(made, run=f"{made.run}_{iterations}")


def test_every_method_with_all_that_is_measured():
    table = methods(run_set(compared(seeds=2)))
    assert [block.title.split()[0] for block in table.blocks] == ["synthetic-outdoor", "synthetic-room"]
    assert {"PSNR", "SSIM", "WS-PSNR", "WS-PSNR pole", "seam", "training s", "ms per frame", "MB"} <= {*columns(table)}
    assert "seam" in [column.heading for column in table.columns], "best at 1: neither more nor less of it is better"
    assert value(table, "synthetic-room", "OmniGS, corrected", "PSNR") == pytest.approx(22 + 0.8 * 3 + 0.05), (
        "mean of two seeds"
    )
    outdoor = next(b for b in table.blocks if "outdoor" in b.title)
    assert next(r for r in outdoor.rows if r.title == "OP43DGS, corrected").cells[0].status == "oom"


def seen_less(**others):
    config = {"train": {"iterations": 1500}, "method": {"rays": 1024}, "seed": 0}
    return small(30, 0.1, method="egonerf", preset="egonerf_small", config=config, **others)


def test_who_saw_far_fewer_pixels_is_shown_and_not_ranked():
    of = run_set([seen_less(), small(25), small(24, 2.0, method="omnigs")])
    table = methods(of)
    assert value(table, "synthetic-room", "EgoNeRF, small", "PSNR") == 30, "the best, at the smallest costs"
    assert value(table, "synthetic-room", "EgoNeRF, small", "images seen") == pytest.approx(1500 * 1024 / (512 * 256))
    assert value(table, "synthetic-room", "PaD-GS", "images seen") == 1500
    assert ranks(table, "synthetic-room") == {"EgoNeRF, small": set(), "OmniGS, corrected": {SECOND}, "PaD-GS": {BEST}}
    reason = "Not ranked: EgoNeRF, small (12 of 1500 images): for it saw less than half"
    text = markdown(table)
    assert "| EgoNeRF, small † |" in text and "| PaD-GS |" in text and f"- † {reason}" in text
    for build in (table1, table4):
        other = build(of)
        assert not ranks(other, "synthetic-room")["EgoNeRF, small"] and any(reason in note for note in other.notes)


def test_after_equal_time_who_saw_fewer_pixels_is_ranked():
    slow = trained("egonerf", 100, 1500, 30, preset="egonerf_small")
    slow = replace(slow, config={**slow.config, "method": {"rays": 1024}})
    table = equal_time(run_set([trained("padgs", 100, 900), trained("omnigs", 100, 900, 24), slow]))
    assert BEST in ranks(table, "synthetic-room")["EgoNeRF, small"] and "Not ranked" not in markdown(table)


@pytest.mark.parametrize(
    ("method", "knob"),
    [("sc_omnigs", "pose_noise_rotation"), ("sc_omnigs", "pose_noise_translation"), ("seam360gs", "lens_gap")],
)
def test_what_calibrates_is_ranked_where_there_is_something_to_calibrate(method, knob):
    def ranked(dataset="synthetic", **generator) -> bool:
        own = {"config": {"data": {"generator": {"scene": "room", **generator}}, "seed": 0}, "dataset": dataset}
        table = methods(run_set([small(20, 1.0, **own), small(30, 0.5, method=method, **own)]))
        (mine,) = {row.title for row in table.blocks[0].rows} - {"PaD-GS"}
        assert "after the abstract" in mine
        noted = [note for note in table.notes if "+experiment=calibration compares it where it is" in note]
        best = bool(ranks(table, "synthetic-room")[mine])
        assert len(noted) == (not best)
        return best

    assert ranked(**{knob: 0.1}) and not ranked(**{knob: 0.0}) and not ranked()
    other = "lens_gap" if method == "sc_omnigs" else "pose_noise_rotation"
    assert not ranked(**{other: 0.1}), "what the other one mends"
    assert not ranked("", **{knob: 0.1}), "a folder's pictures have nothing of the generator"


def test_what_a_method_started_from_and_its_processor_time_have_columns():
    old, new = small(24, method="omnigs"), small(25)
    counts, timing = {**new.counts, "start": 72_000}, {**new.timing, "cpu_seconds": 57.0}
    table = methods(run_set([old, replace(new, counts=counts, timing=timing)]))
    assert [value(table, "synthetic-room", "PaD-GS", name) for name in ("started from", "CPU s")] == [72_000, 57]
    assert value(table, "synthetic-room", "OmniGS, corrected", "started from") is None
    assert "CPU s" not in columns(methods(run_set([old]))) and "started from" in columns(methods(run_set([old])))


def test_learning_rates_are_named_and_not_mixed():
    rates = {"train": {"iterations": 1500, "learning_rates": "run"}, "seed": 0}
    scaled, old = small(25, config=rates), small(24, method="omnigs")
    assert any("learning rates run, seeds" in note for note in methods(run_set([scaled])).notes)
    assert any("learning rates published, seeds" in note for note in methods(run_set([old])).notes)
    with pytest.raises(ReportError, match="differ in learning_rates"):
        methods(run_set([scaled, old]))


def test_runs_of_different_lengths_do_not_stand_together():
    with pytest.raises(ReportError, match="differ in length"):
        methods(run_set([small(25), small(26, method="omnigs", iterations=3000)]))


def test_after_each_time_methods_stand_beside_each_other():
    short = [trained("padgs", 20, 250, 20), trained("omnigs", 20, 300, 21)]
    long = [trained("padgs", 60, 700, 26), trained("omnigs", 60, 900, 27)]
    table = equal_time(run_set([*short, *long]))
    place = "synthetic-room (built in, generated; no scene of the paper)"
    assert [block.title for block in table.blocks] == [f"{place}, 512x256, {s} s of CPU time" for s in (20, 60)]
    for block, *expected in ((f"{place}, 512x256, 20", 250, 20), (f"{place}, 512x256, 60", 700, 26)):
        assert [value(table, block, "PaD-GS", name) for name in ("iterations", "PSNR")] == pytest.approx(expected)


def test_times_of_different_machines_do_not_stand_together():
    runs = [trained("padgs", 100, 900), trained("omnigs", 100, 900, machine={"cores": 64, "cpu": "B", "torch": "2"})]
    for build in (methods, equal_time):
        with pytest.raises(ReportError, match="differ in machine"):
            build(run_set(runs))
        assert build(run_set(runs, mix=True)).blocks


def test_a_scene_of_two_data_sets_has_a_block_for_each():
    runs = [trained("padgs", 100, 900, scene="classroom", dataset=dataset) for dataset in ("", "omniblender")]
    for build in (methods, equal_time):
        capture, rendered = (block.title for block in build(run_set(runs)).blocks)
        assert capture.startswith("classroom (a capture that is no scene of the paper)")
        assert rendered.startswith("classroom (of omniblender; no scene of the paper)")


def test_a_run_that_was_stopped_is_no_seed():
    runs = [trained("padgs", 100, 900, 25), trained("omnigs", 100, 900, 24)]
    stopped = replace(runs[0], run="stopped", seed=9, variant="stopped after 90 iterations")
    assert equal_time(run_set([*runs, stopped])) == equal_time(run_set(runs))


def test_seeds_may_differ_in_what_they_did_in_the_time_but_in_no_setting():
    runs = [trained("padgs", 100, 900, 25), trained("padgs", 100, 950, 27, seed=1)]
    assert value(equal_time(run_set(runs)), "synthetic-room", "PaD-GS", "PSNR") == pytest.approx(26)
    other = replace(runs[1], config={**runs[1].config, "method": {"sh_degree": 0}})
    with pytest.raises(ReportError, match="differ in method.sh_degree"):
        equal_time(run_set([runs[0], other]))


def test_a_method_that_failed_shows_its_status():
    late = replace(trained("odgs", 100, 900), status="timeout", scores={})
    table = equal_time(run_set([trained("padgs", 100, 900), late]))
    assert next(r for r in table.blocks[0].rows if r.title == "ODGS, corrected").cells[0].status == "timeout"
