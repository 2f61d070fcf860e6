"""Rows of single runs, of other programs, of depth, and of scenes that methods were tuned on."""

from dataclasses import replace

import pytest
from support.made_up import at_equal_time, builder, columns, compared, external, failed, result, run_set, small, value

from padgs.reports.writers import markdown

table1, methods, runs, equal_time = map(builder, ("table1", "methods", "runs", "equal_time"))
ROOM = "synthetic-room"


def test_a_line_per_run_and_a_block_per_scene():
    room = replace(result("dagd"), scene="hall", dataset="", run="hall_padgs_0123456789", counts={"anchors": 1234})
    text = markdown(runs(run_set([result("full"), failed("baseline", "oom"), room])))
    assert "### 360Roam, bar, 2048x1024, 30000 iterations" in text
    assert "### hall, 2048x1024" in text
    assert "| padgs, dagd, seed 0, 0123456789 | 23.50 | 0.810 |" in text and "| 1234 |" in text
    assert "| padgs, baseline, seed 0, 0 | OOM | OOM |" in text


def test_rows_of_runs_name_preset_and_changed_keys_and_none_is_the_best():
    release = result("", method="odgs", preset="odgs_release", psnr=24.0)
    text = markdown(runs(run_set([result("", method="odgs"), release])))
    assert "| odgs, seed 0" in text and "| odgs\\_release, seed 0" in text
    assert "**" not in text and "<ins>" not in text
    swept = [replace(result(""), run=f"bar_{tau}", config={"method": {"tau": tau}}) for tau in (0.9, 0.5)]
    (block,) = runs(run_set(swept)).blocks
    assert [row.title for row in block.rows] == ["padgs, tau 0.5, seed 0, 0.5", "padgs, tau 0.9, seed 0, 0.9"]
    assert len(runs(run_set(swept, where={"method.tau": "0.5"})).blocks[0].rows) == 1


def test_models_of_other_programs_have_rows_beside_the_methods():
    made = run_set([*compared([ROOM], seeds=3), external(27.5, "my|splat"), external(20.0, "renders")])
    for build in (methods, table1):
        (block,) = build(made).blocks
        assert [row.title for row in block.rows][-2:] == ["my|splat (external)", "renders (external)"]
    assert value(methods(made), ROOM, "my|splat (external)", "WS-PSNR") == pytest.approx(27.1)
    assert value(methods(made), ROOM, "my|splat (external)", "iterations") is None
    text = markdown(methods(made))
    assert "my\\|splat (external): made by Brush 0.3, and only scored by padgs." in text and "Not ranked" not in text
    assert [block.title for block in runs(made).blocks][0] == f"{ROOM} (generated, tuned on), 512x256, made elsewhere"


def test_depth_has_columns_where_a_run_was_scored_by_it_and_is_chosen_by_name():
    one = small(25.0)
    sphere = replace(
        one.scores["sphere"], metrics={**one.scores["sphere"].metrics, "abs_rel": 0.05, "delta_1_25": 0.98}
    )
    deep = run_set([replace(one, scores={**one.scores, "sphere": sphere})])
    assert value(methods(deep), ROOM, "PaD-GS", "depth AbsRel") == 0.05
    assert not any("depth" in title for title in columns(methods(run_set([one]))))
    chosen = table1(run_set([replace(one, scores={"sphere": sphere})], protocol="sphere", metrics=("delta_1_25",)))
    assert [column.heading for column in chosen.columns] == ["depth δ < 1.25 ↑"]


def test_scenes_tuned_on_and_not_stand_apart():
    known = {
        "room": "e7acbfd00c",
        "flat": "7564c90d88",
        "plaza": "da838962d5",
        "basement": "76aa9660be",
        "garden": "0" * 10,
    }
    made = [
        small(25.0 + n, scene=scene, dataset="", run=scene, fingerprint=data)
        for n, (scene, data) in enumerate(known.items())
    ]
    table = methods(run_set(made))
    assert [block.title for block in table.blocks] == [
        "Average over 2 scenes not tuned on: basement, plaza",
        "Average over 2 scenes tuned on: flat, room",
        "basement (not tuned on)",
        "plaza (not tuned on)",
        "garden",
        "flat (tuned on)",
        "room (tuned on)",
    ]
    assert "not tuned on: none was, but for the exceptions" in "".join(table.notes)
    assert "tuned" not in markdown(methods(run_set(made[-1:])))


def test_means_over_scenes_are_of_one_size_and_length():
    scenes = "synthetic-outdoor, synthetic-room"
    made = at_equal_time("synthetic-room", "synthetic-outdoor")
    shorter = [
        replace(run, run=f"{run.run}-short", config={**run.config, "budget": {"seconds": 20.0, "clock": "cpu"}})
        for run in made
    ]
    table = equal_time(run_set([*made, *shorter]))
    assert [block.title for block in table.blocks[:2]] == [
        f"Average over 2 scenes tuned on: {scenes}, 512x256, {seconds} s of CPU time" for seconds in (60, 20)
    ]
    assert value(table, table.blocks[0].title, "OmniGS, corrected", "WS-PSNR") == pytest.approx((26 + 30) / 2 - 0.4)
    assert "Not ranked" not in "".join(table.notes)
    assert [block.title for block in equal_time(run_set(made[:3])).blocks] == [
        "synthetic-room (generated, tuned on), 512x256, 60 s of CPU time"
    ]


def test_failed_runs_are_named_beside_the_mean_over_scenes_that_leaves_out_their_seeds():
    every = [
        small(25.0 + seed, scene=scene, dataset="", fingerprint=scene, seed=seed)
        for scene in ("hall", "attic")
        for seed in range(3)
    ]

    def mean(*seeds: int) -> list[str]:
        """Return the row of the mean if these seeds fail on one of the scenes."""
        made = [replace(of, status="nan", scores={}) if of.scene == "hall" and of.seed in seeds else of for of in every]
        first = table1(run_set(made)).blocks[0]
        assert first.title == "Average over 2 scenes: attic, hall"
        return first.rows[0].texts(table1(run_set(made)).columns)

    assert mean()[::2] == ["PaD-GS (n=3)", "26.00 ± 1.00"]
    assert mean(2)[::2] == ["PaD-GS (n=2)", "25.50 ± 0.71 [NAN]"]
    assert mean(1, 2)[::2] == ["PaD-GS", "25.00 [NAN]"] and mean(0, 1, 2)[::2] == ["PaD-GS", "NAN"]
