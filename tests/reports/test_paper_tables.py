"""Tables 1-4: ours beside the numbers of the paper."""

import csv
import io
from dataclasses import replace

import pytest
from support.made_up import RULES, builder, data_set, external, failed, result, run_set

from padgs.reports.table import MISSING, ReportError, Table
from padgs.reports.writers import csv_text, latex, markdown
from padgs.results import Scores

table1, table2, table3, table4 = map(builder, ("table1", "table2", "table3", "table4"))
COSTS = {  # group, column -> value of `data_set` or the paper
    ("training h", "training"): 1.0,
    ("training h", "paper"): 1.66,
    ("FPS", "FPS"): 25.0,
    ("FPS", "paper"): 23.12,
    ("", "ms"): 40.0,
    ("", "Gaussians"): 100_000,
    ("", "model"): 24.0,
    ("", "peak"): 2.5,
}
FOUR = [
    result("baseline", psnr=22.30, ssim=0.786, lpips=0.257),
    result("dagd", psnr=23.13, ssim=0.80, lpips=0.24),
    result("dagd_daom_no_m", psnr=23.51, ssim=0.804, lpips=0.245),
    result("full", psnr=23.50, ssim=0.808, lpips=0.230),
]


def cells(table: Table) -> dict[tuple[str, str, str, str], dict[str, str]]:
    """(block, row, group, column) -> the line of the CSV."""
    lines = csv.DictReader(io.StringIO(csv_text(table)))
    return {(line["block"], line["row"], line["group"], line["column"].partition(" ")[0]): line for line in lines}


def block(text: str, title: str) -> list[list[str]]:
    """Cells of a block of Markdown."""
    body = text.split(f"### {title}")[1].split("\n\n### ")[0]
    lines = [line for line in body.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def ablation(results, **request) -> list[list[str]]:
    return block(markdown(table3(run_set(results, **request))), "360Roam, bar")


def repeated(results):
    return [replace(one, seed=seed, run=f"{one.run}{seed}") for one in results for seed in range(3)]


def across(results, metric="PSNR", build=table1) -> dict[str, dict[str, str]]:
    """Row -> method -> cell of a block with scenes down and methods across."""
    body = markdown(build(run_set(results))).split(f"### {metric}")[1].split("\n\n### ")[0]
    heads, _, *rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in body.splitlines() if line[:1] == "|"
    ]
    return {row[0]: dict(zip(heads[1:], row[1:], strict=True)) for row in rows}


def test_published_numbers_stand_below_ours_with_the_difference():
    made = across([result("", psnr=23.5, ssim=0.81, lpips=0.229)])
    assert {row: of["PaD-GS"] for row, of in made.items()} == {"bar": "23.50", "bar, paper": "23.40", "bar, Δ": "+0.10"}
    assert {row: of["OmniGS"] for row, of in made.items()} == {"bar": MISSING, "bar, paper": "22.24", "bar, Δ": MISSING}
    #                               SSIM     paper    Δ         PSNR     paper    Δ        LPIPS    paper    Δ
    assert " ".join(ablation(FOUR)[0]) == "Baseline 0.786 0.786 +0.000 22.30 22.29 +0.01 0.257 0.257 +0.000"


def test_the_layout_is_the_papers_and_the_best_is_sought_along_a_row():
    made = across(repeated([result("", psnr=23.5), result("", method="omnigs", preset="omnigs", psnr=22.0)]))
    assert list(made["bar (n=3)"]) == ["EgoNeRF", "OP43DGS", "ODGS", "OmniGS, corrected", "SPaGS", "PaD-GS"]
    assert made["bar (n=3)"]["PaD-GS"].startswith("**23.50") and "<ins>22.00" in made["bar (n=3)"]["OmniGS, corrected"]
    heads = [line for line in csv.DictReader(io.StringIO(csv_text(table1(run_set(repeated([result("")]))))))]
    assert {"PaD-GS", "OmniGS"} <= {line["column"] for line in heads if line["block"].startswith("PSNR")}


@pytest.mark.parametrize("scene", ["bar", "base"])
def test_a_method_that_one_scene_lacks_keeps_its_numbers_in_others(scene):
    made = [result("", scene=one, run=one, fingerprint=one) for one in ("bar", "base")]
    found = across([*made, result("", method="odgs", psnr=21.0, scene=scene, run="odgs", fingerprint=scene)])
    other = "base" if scene == "bar" else "bar"
    assert found[scene]["ODGS, corrected"] == "21.00" and found[other]["ODGS, corrected"] == MISSING
    assert MISSING not in (found[f"{one}, paper"]["ODGS, corrected"] for one in ("bar", "base"))


@pytest.mark.parametrize("other", [{"width": 512, "height": 256}, {"iterations": 7000}])
def test_there_is_a_difference_at_the_size_and_length_of_the_paper_only(other):
    assert "bar, Δ" not in across([result("", **other)])
    whole = {"paper": replace(result("").scores["paper"], protocol=RULES)}
    assert "bar, Δ" not in across([result("", scores=whole)]), "the paper cuts off the robot"
    both = across([result(""), result("", method="egonerf", preset="egonerf")])
    assert both["bar, Δ"]["PaD-GS"] == "+0.10" and both["bar, Δ"]["EgoNeRF"] == MISSING, "published with 100 000"
    seconds = result("", config={"budget": {"seconds": 60.0, "clock": "cpu"}})
    assert "bar, Δ" not in across([seconds])
    for budget in ({"gaussians": 20_000}, {"stop": "auto"}):  # other models than the paper's, or shorter
        assert "bar, Δ" not in across([result("", config={"budget": budget})])
    assert "Δ |" not in markdown(table3(run_set([result("full", **other)])))


def test_failures_of_ours_and_of_the_paper():
    bricks = failed("", "oom", dataset="ricoh360", scene="bricks")
    made = across([bricks], build=table2)
    assert made["bricks"]["PaD-GS"] == "OOM" and made["bricks, paper"]["OP43DGS"] == "OOM"


def test_the_average_is_over_the_scenes_that_were_run_for_the_paper_too():
    some = [run for run in data_set("roam360") if run.scene in ("bar", "lab")]
    title = "360Roam, average over 2 of its 11 scenes: bar, lab"
    found = cells(table1(run_set(some)))
    assert float(found[title, "PaD-GS", "PSNR", "PSNR"]["value"]) == pytest.approx((20.5 + 28.5) / 2)
    assert float(found[title, "PaD-GS", "PSNR", "paper"]["value"]) == pytest.approx((23.40 + 29.45) / 2)
    assert float(found[title, "PaD-GS", "PSNR", "Δ"]["value"]) == pytest.approx(24.5 - 26.425)
    assert table1(run_set(some)).blocks[0].title == title and title in latex(table1(run_set(some)))
    assert not any("average" in block.title for block in table1(run_set(some[:2])).blocks), "one scene"
    bricks = [run for run in data_set("ricoh360") if run.scene in ("bricks", "farm")]
    rows = {row[0]: row for row in block(markdown(table2(run_set(bricks))), "Ricoh360, average")}
    assert set(rows["OP43DGS"][1:]) == {MISSING}, "out of memory"


def test_a_scene_that_ran_in_two_sizes_is_not_called_one_that_was_not_run():
    some = [run for run in data_set("roam360") if run.scene in ("bar", "lab", "canteen")]
    wider = [replace(run, run=f"{run.run}_wide", width=3840, height=1920) for run in some if run.scene == "bar"]
    (notes,) = [table.notes for table in [run_set([*some, *wider]).report("table1")]]
    assert "360Roam, in no mean, as its runs differ: bar." in notes
    assert not any("not run" in note and "bar" in note.partition("not run")[2] for note in notes)


def test_any_scenes_have_a_mean_and_nothing_of_the_paper_unless_its_data_sets_were_run():
    mine = [
        replace(run, dataset="", scene=f"my_{run.scene}", config={**run.config, "data": {"path": run.scene}})
        for run in data_set("roam360", seeds=2)
        if run.scene in ("bar", "lab")
    ]
    table = table1(run_set(mine))
    assert [block.title for block in table.blocks] == ["Average over 2 scenes: my_bar, my_lab", "my_bar", "my_lab"]
    found = cells(table)["Average over 2 scenes: my_bar, my_lab", "PaD-GS", "PSNR", "PSNR"]
    assert float(found["value"]) == pytest.approx(24.55) and found["n"] == "2"
    for build in (table1, table2, table3, table4, builder("methods")):
        text = markdown(build(run_set(mine)))
        assert not any(word in text for word in ("paper ", "Δ", "360Roam", "Ricoh360", "3090", "of the paper"))
    own = []  # voxels in the units of each scene, and a file of another program for each
    for run in mine:
        size = 0.01 if run.scene == "my_bar" else 0.02
        config = {**run.config, "data": {"voxel_size": size}, "method": {"voxel_size": size}}
        own.append(replace(run, config=config))
        model = {"method": {"sha256": run.scene}, "train": {"learning_rates": "run"}}
        if run.method == "padgs" and run.seed == 0:
            more = {"scene": run.scene, "dataset": "", "fingerprint": run.fingerprint, "width": 2048, "height": 1024}
            more["scores"] = run.scores
            made = external(30.0, "Brush", config=model, **more)
            own.append(replace(made, run=f"brush_{run.scene}", preset="brush"))
    found = cells(table1(run_set(own)))
    title = "Average over 2 scenes: my_bar, my_lab"
    assert float(found[title, "PaD-GS", "PSNR", "PSNR"]["value"]) == pytest.approx(24.55)
    assert float(found[title, "Brush (external)", "PSNR", "PSNR"]["value"]) == pytest.approx(24.5)
    sizes = [*mine, *(replace(run, scene="wide", width=4096, height=2048, run=f"w{run.run}") for run in mine[:4])]
    table = table1(run_set(sizes))
    assert "No mean over the scenes: " in "".join(table.notes) and len(table.blocks) == 3


def test_methods_and_scenes_are_chosen_by_names_and_patterns():
    made = data_set("roam360", methods=("omnigs", "padgs", "odgs"))
    made += [replace(made[0], dataset="", scene="my_room", run="mine")]

    def shown(**request) -> tuple[set[str], set[str]]:
        runs = run_set(made, **request).requested
        return set(runs["scene"]), set(runs["preset"])

    assert shown(scenes=("my-room",)) == ({"my_room"}, {"omnigs"})
    flat = replace(made[0], dataset="", scene="Flat [2]", run="flat")
    brackets = run_set([*made, flat], scenes=("Flat [2]",)).requested
    assert set(brackets["scene"]) == {"Flat [2]"}, "as it is written"
    assert shown(scenes=("lab", "c?nter*"))[0] == {"lab", "center", "center1"}
    assert shown(scenes=("roam360",), methods=("o*",)) == (shown()[0] - {"my_room"}, {"omnigs", "odgs"})
    assert shown(where={"scene": "bar", "method": "padgs"}) == ({"bar"}, {"padgs"})
    with pytest.raises(ReportError, match="no run has scene attic; runs have bar, base"):
        shown(scenes=("attic",))
    with pytest.raises(ReportError, match="no run has method spags; runs have odgs, omnigs, padgs"):
        shown(where={"method": "spags"})


def test_columns_are_chosen_by_name():
    table = table1(run_set(data_set("roam360"), metrics=("psnr", "frame_ms")))
    assert [column.title for column in table.columns] == ["PSNR", "paper", "Δ", "ms per frame"]
    with pytest.raises(ReportError, match="unknown metric 'pnsr'; known under protocol paper: psnr"):
        table1(run_set(data_set("roam360"), metrics=("pnsr",)))
    for block in table1(run_set(data_set("roam360"), metrics=("frame_ms", "psnr"))).blocks:
        if block.across:
            kinds = {row.title.partition(", ")[2] for row in block.rows}
            assert kinds == ({"", "paper", "Δ"} if "PSNR" in block.title else {""}), "no decibels among milliseconds"


def test_the_average_over_all_scenes():
    title = "360Roam, average over its 11 scenes"
    average = cells(table1(run_set(data_set("roam360", seeds=2))))
    ours = average[title, "OmniGS, corrected", "PSNR", "PSNR"]
    assert float(ours["value"]) == pytest.approx(20 + 5 + 0.05) and ours["n"] == "2"  # scenes 0..10, seeds 0, 1
    assert float(ours["std"]) == pytest.approx(0.1 / 2**0.5)
    assert average[title, "OmniGS, corrected", "PSNR", "paper"]["value"] == "24.84"
    assert float(average[title, "OmniGS, corrected", "PSNR", "Δ"]["value"]) == pytest.approx(25.05 - 24.84)


def test_the_average_of_an_incomplete_column_is_missing():
    all_but_one = [r for r in data_set("roam360") if (r.scene, r.method) != ("lab", "omnigs")]
    rows = {row[0]: row for row in block(markdown(table1(run_set(all_but_one))), "360Roam, average")}
    assert rows["OmniGS, corrected"][4] == MISSING and rows["PaD-GS"][4] == "25.50"
    broken = [r if r.scene != "lab" else replace(r, status="oom", scores={}) for r in data_set("roam360")]
    found = cells(table1(run_set(broken)))
    for method in ("OmniGS, corrected", "PaD-GS"):
        assert found["360Roam, average over its 11 scenes", method, "PSNR", "PSNR"]["value"] == ""


def test_other_scenes_have_blocks_of_their_own_with_their_origin():
    room = result("", dataset="synthetic", scene="synthetic-room")
    outdoor, capture = replace(room, scene="synthetic-outdoor"), replace(room, dataset="", scene="hall")
    indoor, outdoors = (markdown(build(run_set([room, outdoor, capture]))) for build in (table1, table2))
    assert "### synthetic-room (generated, tuned on)" in indoor and "### hall\n" in indoor
    assert "synthetic-outdoor" in outdoors and "hall" not in outdoors and "synthetic-outdoor" not in indoor
    parts = markdown(table3(run_set([replace(row, dataset="synthetic", scene="synthetic-room") for row in FOUR])))
    assert "### synthetic-room" in parts and "| Baseline | 0.786 | 22.30 | 0.257 |" in parts


def test_presets_of_a_method_stand_beside_each_other():
    runs = [result("", method="odgs", preset=preset) for preset in ("odgs", "odgs_release", "odgs_fast")]
    published = across(runs)["bar, paper"]
    assert published["ODGS, corrected"] == published["ODGS, as released, gradients corrected"] == "20.17"
    assert published["ODGS, fast"] == MISSING


def test_only_runs_of_the_tables_own_experiments_compete_where_there_are_any():
    own = result("", experiments=("table1_360roam@cpu", "tau@cpu"))
    trial = result("", psnr=9.0, experiments=("smoke",), iterations=7)
    other_tau = result("", psnr=8.0, experiments=("tau@cpu",), config={"method": {"tau": 0.5}})
    for build in (table1, table4):
        build(run_set([own, trial, other_tau]))
    assert across([own, trial, other_tau])["bar"]["PaD-GS"] == "23.50"
    with pytest.raises(ReportError, match="differ in length"):
        table1(run_set([replace(r, experiments=()) for r in (own, trial)]))
    assert "9.00" in markdown(table1(run_set([own, trial], experiment="smoke")))


def test_scenes_without_an_experiment_of_the_table_show_ad_hoc_runs():
    own = result("", experiments=("table1_360roam",))
    room = [result("", dataset="", scene="room"), result("", dataset="", scene="room", psnr=9.0, experiments=("tau",))]
    assert block(markdown(table1(run_set([own, *room]))), "room")[0][2] == "23.50"


def test_rows_of_an_ablation_are_not_methods():
    assert "23.50" not in markdown(table1(run_set([result("full")])))


def test_efficiency_beside_the_published_hours_and_frames():
    found = cells(table4(run_set(data_set("ricoh360"))))
    title = "Ricoh360, average over its 12 scenes"
    values = {(group, column): float(found[title, "PaD-GS", group, column]["value"]) for group, column in COSTS}
    assert values == COSTS


def test_memory_of_a_gpu_has_a_column_if_a_run_was_on_one():
    on_gpu = [replace(r, peak_device_memory_bytes=7_250_000_000) for r in data_set("ricoh360")]
    for build in (table4, builder("runs")):
        assert "peak GPU GB" not in markdown(build(run_set(data_set("ricoh360"))))
        text = markdown(build(run_set(on_gpu)))
        assert "peak GPU GB" in text and "7.25" in text
    found = block(markdown(table4(run_set(on_gpu))), "Ricoh360, average over its 12 scenes")
    assert [cell.strip("*") for cell in found[-1][-2:]] == ["2.50", "7.25"]


def test_times_of_two_machines_are_not_compared_without_mix():
    here = data_set("roam360", methods=("padgs",))
    there = [replace(r, method="omnigs", preset="omnigs", machine={**r.machine, "cores": 64}) for r in here]
    table1(run_set([*here, *there]))
    with pytest.raises(ReportError, match="differ in machine .*64 cores.*--mix"):
        table4(run_set([*here, *there]))
    table4(run_set([*here, *there], mix=True))


def test_averages_mix_neither_rules_nor_settings():
    runs = data_set("roam360")
    with pytest.raises(ReportError, match="differ in resolution"):
        table1(run_set([*runs[:3], *(replace(r, width=512, height=256) for r in runs[3:])]))
    runs[1] = replace(runs[1], config={**runs[1].config, "method": {"tau": 0.0}})
    for build in (table1, table4):
        with pytest.raises(ReportError, match="360Roam, PaD-GS: runs bar_padgs_0 and .* differ in method.tau"):
            build(run_set(runs))


@pytest.mark.parametrize(
    ("run", "note"),
    [
        (result("", method="egonerf", preset="egonerf_small"), "EgoNeRF is published with 100000 iterations"),
        (result("", method="egonerf", iterations=100_000), ""),
        (replace(result("", method="odgs"), preset="odgs_release", width=512, height=256), "draws half a pixel off"),
        (replace(result("", method="odgs"), preset="odgs_release", width=1920, height=960), ""),
        (replace(result("", method="odgs"), width=512, height=256), ""),
    ],
)
def test_footnotes_on_published_lengths_and_pixels(run, note):
    text = markdown(table1(run_set([run])))
    for known in ("is published with", "draws half a pixel off"):
        assert (known in text) == (known in note)
    assert note in text


@pytest.mark.parametrize(("build", "made"), [(table4, data_set("roam360")), (table3, FOUR)])
def test_footnotes_name_the_conditions(build, made):
    text = markdown(build(run_set(made)))
    note = next(line for line in text.splitlines() if line.startswith("- 360Roam, bar"))
    for words in ("paper, LPIPS-vgg fed \\[0, 1\\]", "2048x1024", "30000 iterations", "0.1.0 abc", "2 cores of A & B"):
        assert words in note
    assert "seeds 0" in note and ("RTX 3090" in text)


def test_a_footnote_names_rows_whose_seeds_are_of_several_versions():
    made = [replace(run, code_version=f"0.1.{run.seed}") for run in data_set("roam360", seeds=2) if run.scene == "bar"]
    note = "360Roam, bar: seeds of OmniGS, corrected, PaD-GS are of several versions of padgs."
    assert note in table1(run_set(made)).notes
    assert not any("several versions" in one for one in table1(run_set(data_set("roam360", seeds=2))).notes)


def test_the_best_of_each_column_is_bold_by_its_own_direction():
    rows = ablation(repeated(FOUR))
    bold = [[index for index, row in enumerate(rows) if row[column].startswith("**")] for column in (1, 4, 7)]
    assert bold == [[3], [2], [3]] and not any("*" in row[column] for row in rows for column in (2, 3, 5, 6, 8, 9))
    assert not any("*" in cell for row in ablation(FOUR) for cell in row), "one seed"


def test_numbers_that_print_alike_are_equally_good():
    made = [result("baseline", psnr=23.0), result("dagd", psnr=23.501), result("full", psnr=23.499)]
    rows = ablation(repeated(made))
    assert [row[4].partition(" ")[0] for row in rows] == ["<ins>23.00", "**23.50", MISSING, "**23.50"]


def test_missing_and_failed_cells():
    rows = ablation([failed("baseline", "oom"), result("full", lpips=None)])
    assert rows[0][1::3] == ["OOM"] * 3 and rows[1][1::3] == [MISSING] * 3
    assert rows[3][7] == MISSING and rows[3][4] == "23.50"
    assert table3(run_set([])).blocks == ()


def test_seeds_are_averaged_with_their_deviation():
    rows = ablation([result("full", psnr=23.0, seed=0), result("full", psnr=24.0, seed=1)])
    assert rows[3][0].endswith(" (n=2)") and rows[3][4] == "23.50 ± 0.71"
    assert ablation([result("full", psnr=23.0, seed=0), failed("full", "nan", seed=1)])[3][4] == "23.00 \\[NAN\\]"
    kept = [result("full", psnr=psnr, seed=seed) for seed, psnr in enumerate((23.0, 24.0, 25.0))]
    kept[2].scores["paper"].metrics.pop("ssim")
    row = ablation(kept)[3]
    assert "n=" not in row[0] and row[4] == "24.00 ± 1.00 (n=3)" and row[1].endswith("(n=2)")


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (replace(FOUR[1], width=512, height=256), "resolution"),
        (replace(FOUR[1], iterations=7), "length"),
        (replace(FOUR[1], fingerprint="other"), "data"),
        (
            replace(FOUR[1], scores={"paper": Scores({**RULES, "lpips": "alex"}, FOUR[1].scores["paper"].metrics, {})}),
            "paper rules",
        ),
    ],
)
def test_runs_under_other_conditions_are_not_compared_without_mix(other, what):
    with pytest.raises(ReportError, match=f"360Roam, bar: results differ in {what} .*--where.*--mix"):
        table3(run_set([FOUR[0], other]))
    table3(run_set([FOUR[0], other], mix=True))


def test_two_settings_never_share_a_cell_and_where_chooses():
    other = replace(FOUR[3], config={**FOUR[3].config, "method": {"tau": 0.5}}, run="other", seed=1)
    with pytest.raises(ReportError, match="differ in method.tau"):
        table3(run_set([FOUR[3], other], mix=True))
    assert ablation([FOUR[3], other], where={"method.tau": "0.5"})[3][4] == "23.50"


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (
            {"where": {"train.its": "3"}},
            "unknown key 'train.its'; known in run bar_padgs_full_0: train.iterations, method.tau",
        ),
        ({"protocol": "flat"}, "unknown protocol 'flat'; known: paper, sphere"),
    ],
)
def test_an_unknown_key_or_protocol_lists_the_known(request_, message):
    with pytest.raises(ReportError, match=message):
        run_set(FOUR[3:], **request_)


def test_spherical_metrics_are_not_put_beside_published_ones():
    metrics = {"ws_psnr": 25.0, "ws_ssim": 0.8, "ws_lpips_alex": 0.2}
    sphere = replace(result("full"), scores={"sphere": Scores(RULES, metrics, {})})
    text = markdown(table3(run_set([sphere], protocol="sphere")))
    assert "| + DAGD + DAOM + M | 0.800 | 25.00 | 0.200 |" in text and "| paper" not in text
