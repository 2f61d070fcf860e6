from dataclasses import replace

from made_up import builder, failed, result, run_set

from padgs.reports.writers import markdown

runs = builder("runs")


def test_a_line_per_run_and_a_block_per_scene():
    room = replace(result("dagd"), scene="room", dataset="", run="room_padgs_0123456789", counts={"anchors": 1234})
    text = markdown(runs(run_set([result("full"), failed("baseline", "oom"), room])))
    assert (
        "### 360Roam, bar, 2048x1024, 30000 iterations" in text
        and "### room (a capture that is no scene of the paper), 2048x1024" in text
    )
    assert "| padgs, dagd, seed 0, 0123456789 | 23.50 | 0.810 |" in text and "| 1234 |" in text
    assert "| padgs, baseline, seed 0, 0 | OOM | OOM |" in text


def test_where_chooses():
    other = replace(result("dagd"), config={"method": {"tau": 0.5}})
    assert len(runs(run_set([result("full"), other], where={"method.tau": "0.5"})).blocks[0].rows) == 1


def test_presets_of_a_method_are_told_apart_and_nothing_stands_out():
    release = result("", method="odgs", preset="odgs_release", psnr=24.0)
    text = markdown(runs(run_set([result("", method="odgs"), release])))
    assert "| odgs, seed 0" in text and "| odgs\\_release, seed 0" in text
    assert "**" not in text and "<ins>" not in text


def test_runs_of_a_sweep_say_what_was_swept():
    swept = [replace(result(""), run=f"bar_{tau}", config={"method": {"tau": tau}}) for tau in (0.9, 0.5)]
    (block,) = runs(run_set(swept)).blocks
    assert [row.title for row in block.rows] == ["padgs, tau 0.5, seed 0, 0.5", "padgs, tau 0.9, seed 0, 0.9"]
