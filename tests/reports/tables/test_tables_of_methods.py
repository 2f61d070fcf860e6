import csv
import io
from dataclasses import replace

import pytest
from made_up import builder, data_set, failed, result, run_set

from padgs.reports.table import MISSING, ReportError, Table
from padgs.reports.writers import csv_text, markdown

runs = builder("runs")
table1 = builder("table1")
table2 = builder("table2")
table4 = builder("table4")

COSTS = {  # what data_set has, and the paper: group, column -> value
    ("training h", "training"): 1.0,
    ("training h", "paper"): 1.66,
    ("FPS", "FPS"): 25.0,
    ("FPS", "paper"): 23.12,
    ("", "ms"): 40.0,
    ("", "Gaussians"): 100_000,
    ("", "model"): 24.0,
    ("", "peak"): 2.5,
}


def cells(table: Table) -> dict[tuple[str, str, str, str], dict[str, str]]:
    """(block, row, group, column) -> the line of the CSV."""
    lines = csv.DictReader(io.StringIO(csv_text(table)))
    return {(line["block"], line["row"], line["group"], line["column"].partition(" ")[0]): line for line in lines}


def block(text: str, title: str) -> list[list[str]]:
    body = text.split(f"### {title}")[1].split("\n\n### ")[0]
    lines = [line for line in body.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_published_numbers_stand_beside_ours_with_the_difference():
    text = markdown(table1(run_set([result("", psnr=23.5, ssim=0.81, lpips=0.229)])))
    padgs = block(text, "360Roam, bar")[-1]
    assert padgs[:4] == ["PaD-GS", "0.810", "**0.808**", "+0.002"] and padgs[4:7] == ["23.50", "**23.40**", "+0.10"]
    omnigs = next(row for row in block(text, "360Roam, bar") if row[0] == "OmniGS")
    assert omnigs[:4] == ["OmniGS", MISSING, "<ins>0.783</ins>", MISSING]


def test_a_failure_of_ours_and_of_the_paper_says_so():
    bricks = failed("", "oom", dataset="ricoh360", scene="bricks")
    rows = {row[0]: row for row in block(markdown(table2(run_set([bricks]))), "Ricoh360, bricks")}
    assert rows["PaD-GS"][1] == "OOM" and rows["OP43DGS"][2] == "OOM"


def test_the_average_of_all_scenes_is_theirs():
    title = "360Roam, average over its 11 scenes"
    average = cells(table1(run_set(data_set("roam360", seeds=2))))
    ours = average[title, "OmniGS, corrected", "PSNR", "PSNR"]
    assert float(ours["value"]) == pytest.approx(20 + 5 + 0.05) and ours["n"] == "2"  # scenes 0..10, seeds 0, 1
    assert float(ours["std"]) == pytest.approx(0.1 / 2**0.5)
    assert average[title, "OmniGS, corrected", "PSNR", "paper"]["value"] == "24.84"
    assert float(average[title, "OmniGS, corrected", "PSNR", "Δ"]["value"]) == pytest.approx(25.05 - 24.84)


def test_the_average_of_an_incomplete_column_is_missing():
    all_but_one = [r for r in data_set("roam360") if (r.scene, r.method) != ("lab", "omnigs")]
    table = table1(run_set(all_but_one))
    rows = {row[0]: row for row in block(markdown(table), "360Roam, average")}
    assert rows["OmniGS, corrected"][4] == MISSING and rows["PaD-GS"][4] == "25.50"
    broken = [r if r.scene != "lab" else replace(r, status="oom", scores={}) for r in data_set("roam360")]
    found = cells(table1(run_set(broken)))
    assert {
        found["360Roam, average over its 11 scenes", m, "PSNR", "PSNR"]["value"]
        for m in ("OmniGS, corrected", "PaD-GS")
    } == {""}
    op43dgs = next(r for r in block(markdown(table2(run_set([]))), "Ricoh360, average") if r[0] == "OP43DGS")
    assert set(op43dgs[1:]) == {MISSING}


def test_stand_ins_have_blocks_of_their_own_and_say_what_they_are():
    room = result("", dataset="synthetic", scene="synthetic-room")
    outdoor = replace(room, scene="synthetic-outdoor")
    capture = replace(room, dataset="", scene="flat")
    indoor, outdoors = (markdown(build(run_set([room, outdoor, capture]))) for build in (table1, table2))
    assert "### synthetic-room (built in, generated; no scene of the paper)" in indoor
    assert "### flat (a capture that is no scene of the paper)" in indoor
    assert "synthetic-outdoor" in outdoors and "flat" not in outdoors and "synthetic-outdoor" not in indoor
    assert "360Roam, not run: bar, base" in indoor


def test_presets_of_a_method_are_rows_of_their_own():
    runs = [result("", method="odgs", preset=preset) for preset in ("odgs", "odgs_release", "odgs_fast")]
    rows = {row[0]: row for row in block(markdown(table1(run_set(runs))), "360Roam, bar")}
    released = rows["ODGS, as released, gradients corrected"]
    assert rows["ODGS, corrected"][5].strip("*") == released[5].strip("*") == "20.17"
    assert rows["ODGS, fast"][5] == MISSING


def test_only_runs_of_the_tables_own_experiments_compete_where_there_are_any():
    own = result("", experiments=("table1_360roam@cpu", "tau@cpu"))
    trial = result("", psnr=9.0, experiments=("smoke",), iterations=7)
    other_tau = result("", psnr=8.0, experiments=("tau@cpu",), config={"method": {"tau": 0.5}})
    for build in (table1, table4):
        build(run_set([own, trial, other_tau]))
    assert block(markdown(table1(run_set([own, trial, other_tau]))), "360Roam, bar")[-1][4] == "23.50"
    with pytest.raises(ReportError, match="differ in length"):
        table1(run_set([replace(r, experiments=()) for r in (own, trial)]))
    assert block(markdown(table1(run_set([own, trial], experiment="smoke"))), "360Roam, bar")[-1][4] == "9.00"


def test_scenes_without_an_experiment_of_the_table_show_what_was_run_freely():
    own = result("", experiments=("table1_360roam",))
    room = [result("", dataset="", scene="room"), result("", dataset="", scene="room", psnr=9.0, experiments=("tau",))]
    text = markdown(table1(run_set([own, *room])))
    assert block(text, "room (a capture")[0][2] == "23.50"


def test_rows_of_an_ablation_are_not_methods():
    assert "23.50" not in markdown(table1(run_set([result("full")])))


def test_efficiency_beside_the_published_hours_and_frames():
    title = "Ricoh360, average over its 12 scenes"
    found = cells(table4(run_set(data_set("ricoh360"))))
    values = {(group, column): float(found[title, "PaD-GS", group, column]["value"]) for group, column in COSTS}
    assert values == COSTS


def test_memory_of_a_gpu_has_a_column_where_a_run_was_on_one():
    title = "Ricoh360, average over its 12 scenes"
    on_gpu = [replace(r, peak_device_memory_bytes=7_250_000_000) for r in data_set("ricoh360")]
    for build in (table4, runs):
        assert "peak GPU GB" not in markdown(build(run_set(data_set("ricoh360"))))
        assert "peak GPU GB" in markdown(build(run_set(on_gpu))) and "7.25" in markdown(build(run_set(on_gpu)))
    found = block(markdown(table4(run_set(on_gpu))), title)
    assert [cell.strip("*") for cell in found[-1][-2:]] == ["2.50", "7.25"]
    assert "of the tensors on the GPU" in markdown(table4(run_set(on_gpu)))


def test_times_of_two_machines_are_not_compared_unless_told():
    here = data_set("roam360", methods=("padgs",))
    there = [replace(r, method="omnigs", preset="omnigs", machine={**r.machine, "cores": 64}) for r in here]
    table1(run_set([*here, *there]))
    with pytest.raises(ReportError, match="differ in machine .*64 cores.*--mix"):
        table4(run_set([*here, *there]))
    table4(run_set([*here, *there], mix=True))


def test_scenes_of_a_data_set_scored_by_other_rules_are_not_averaged():
    runs = data_set("roam360")
    runs[3:] = [replace(r, width=512, height=256) for r in runs[3:]]
    with pytest.raises(ReportError, match="differ in resolution"):
        table1(run_set(runs))


def test_settings_are_not_mixed_in_an_average():
    runs = data_set("roam360")
    runs[1] = replace(runs[1], config={**runs[1].config, "method": {"tau": 0.0}})
    for build in (table1, table4):
        with pytest.raises(ReportError, match="360Roam, PaD-GS: runs bar_padgs_0 and .* differ in method.tau"):
            build(run_set(runs))


def test_footnotes_say_who_is_published_with_more_iterations():
    note = "EgoNeRF is published with 100000 iterations"
    assert note in markdown(table1(run_set([result("", method="egonerf", preset="egonerf_small")])))
    assert note not in markdown(table1(run_set([result("", method="egonerf", iterations=100_000)])))
    assert note not in markdown(table1(run_set([result("")])))


def test_footnotes_say_whose_constants_are_pixels_of_wider_panoramas():
    note = "ODGS, as released, gradients corrected draws half a pixel off, which is 0.09 degrees at a width of 2048"
    for preset, width, noted in (("odgs_release", 512, True), ("odgs_release", 1920, False), ("odgs", 512, False)):
        run = replace(result("", method="odgs"), preset=preset, width=width, height=width // 2)
        assert (note in markdown(table1(run_set([run])))) == noted


def test_footnotes_say_how_and_where():
    text = markdown(table4(run_set(data_set("roam360"))))
    for words in ("paper, LPIPS-vgg fed", "2048x1024", "30000 iterations", "0.1.0 abc", "2 cores of A & B", "RTX 3090"):
        assert words in text
