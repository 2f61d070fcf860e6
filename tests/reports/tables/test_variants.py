from dataclasses import replace

import pytest
from made_up import RULES, builder, failed, result, run_set, small
from omegaconf import OmegaConf

from padgs.reports.specs import DEVIATIONS, PARTS, RUNGS, WITHOUT
from padgs.reports.table import MISSING, ReportError
from padgs.reports.writers import markdown
from padgs.results import Scores

ladder = builder("ladder")
quirks = builder("deviations")
table3 = builder("table3")

FOUR = [
    result("baseline", psnr=22.30, ssim=0.786, lpips=0.257),
    result("dagd", psnr=23.13, ssim=0.80, lpips=0.24),
    result("dagd_daom_no_m", psnr=23.51, ssim=0.804, lpips=0.245),
    result("full", psnr=23.50, ssim=0.808, lpips=0.230),
]


def lines(results, **request) -> list[list[str]]:
    """Cells of the rows of 360Roam, bar, as Markdown."""
    text = markdown(table3(run_set(results, **request)))
    block = text.split("### ")[1]
    assert block.startswith("360Roam, bar")
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in block.splitlines() if line.startswith("|")][2:]


@pytest.mark.parametrize(
    "table, titles",
    [
        ("ablation", {**PARTS, **RUNGS}),
        ("plus_ablation", WITHOUT),
        ("deviation", {variant: title for titles in DEVIATIONS.values() for variant, title in titles.items()}),
    ],
)
def test_each_variant_that_can_be_run_has_a_row(root, table, titles):
    rows = OmegaConf.load(root / "conf" / "variants" / f"{table}.yaml")
    assert {variant: row.title for variant, row in rows.items()} == titles


def test_published_numbers_stand_beside_ours_with_the_difference():
    baseline = lines(FOUR)[0]
    #                    SSIM   paper  delta    PSNR   paper  delta    LPIPS  paper   delta
    assert baseline == ["Baseline", "0.786", "0.786", "+0.000", "22.30", "22.29", "+0.01", "0.257", "0.257", "+0.000"]


def test_the_best_of_each_column_is_bold_by_its_own_direction():
    rows = lines(FOUR)
    bold = [[index for index, row in enumerate(rows) if row[column].startswith("**")] for column in range(1, 10)]
    assert bold == [[3], [3], [], [2], [3], [], [3], [3], []]


def test_what_prints_the_same_is_equally_good():
    rows = lines([result("baseline", psnr=23.0), result("dagd", psnr=23.501), result("full", psnr=23.499)])
    assert [row[4] for row in rows] == ["<ins>23.00</ins>", "**23.50**", MISSING, "**23.50**"]


def test_missing_and_failed_cells_say_so():
    rows = lines([failed("baseline", "oom"), result("full", lpips=None)])
    assert rows[0][1::3] == ["OOM"] * 3 and rows[1][1::3] == [MISSING] * 3
    assert rows[3][7] == MISSING and rows[3][4] == "23.50"


def test_without_any_result_the_published_numbers_remain():
    text = markdown(table3(run_set([])))
    assert "24.92" in text and "Ricoh360, cat\\_tower: not run" in text


def test_seeds_are_averaged_with_their_spread():
    rows = lines([result("full", psnr=23.0, seed=0), result("full", psnr=24.0, seed=1)])
    assert rows[3][0].endswith(" (n=2)") and rows[3][4] == "23.50 ± 0.71"


def test_numbers_of_seeds_that_differ_stand_in_the_cells():
    kept = [result("full", psnr=psnr, seed=seed) for seed, psnr in enumerate((23.0, 24.0, 25.0))]
    kept[2].scores["paper"].metrics.pop("ssim")
    row = lines(kept)[3]
    assert "n=" not in row[0] and row[4] == "24.00 ± 1.00 (n=3)" and row[1].endswith("(n=2)")


def test_a_seed_that_failed_is_not_hidden():
    rows = lines([result("full", psnr=23.0, seed=0), failed("full", "nan", seed=1)])
    assert rows[3][4] == "23.00 [NAN]"


def test_any_scene_gets_a_block_and_needs_no_published_numbers():
    room = [replace(row, dataset="synthetic", scene="synthetic-room") for row in FOUR]
    text = markdown(table3(run_set(room)))
    assert "### synthetic-room" in text and "| Baseline | 0.786 | 22.30 | 0.257 |" in text


def test_the_footnote_says_how_the_numbers_were_made():
    text = markdown(table3(run_set(FOUR)))
    note = next(line for line in text.splitlines() if line.startswith("- 360Roam, bar"))
    for words in (
        "paper, LPIPS-vgg fed [0, 1]",
        "2048x1024",
        "30000 iterations",
        "seeds 0",
        "0.1.0 abc",
        "2 cores of A & B",
    ):
        assert words in note


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (replace(FOUR[1], width=512, height=256), "resolution"),
        (replace(FOUR[1], iterations=7), "length"),
        (replace(FOUR[1], fingerprint="other"), "data"),
        (
            replace(FOUR[1], scores={"paper": Scores({**RULES, "lpips": "alex"}, FOUR[1].scores["paper"].metrics, {})}),
            "protocol",
        ),
    ],
)
def test_what_was_made_otherwise_is_not_compared_unless_told(other, what):
    with pytest.raises(ReportError, match=f"360Roam, bar: results differ in {what} .*--where.*--mix"):
        table3(run_set([FOUR[0], other]))
    table3(run_set([FOUR[0], other], mix=True))


def test_two_settings_never_share_a_cell_and_where_chooses_between_them():
    other = replace(FOUR[3], config={**FOUR[3].config, "method": {"tau": 0.5}}, run="other", seed=1)
    with pytest.raises(ReportError, match="differ in method.tau"):
        table3(run_set([FOUR[3], other], mix=True))
    assert lines([FOUR[3], other], where={"method.tau": "0.5"})[3][4] == "23.50"


def test_an_unknown_key_lists_its_neighbours():
    with pytest.raises(
        ReportError, match="unknown key 'train.its'; known in run bar_padgs_full_0: train.iterations, method.tau"
    ):
        table3(run_set(FOUR[3:], where={"train.its": "3"}))


def test_an_unknown_protocol_lists_the_known():
    with pytest.raises(ReportError, match="unknown protocol 'flat'; known: paper, sphere"):
        table3(run_set([], protocol="flat"))


def test_marks_of_the_sphere_are_not_put_beside_published_ones():
    marks = {"ws_psnr": 25.0, "ws_ssim": 0.8, "ws_lpips_alex": 0.2}
    sphere = replace(result("full"), scores={"sphere": Scores(RULES, marks, {})})
    text = markdown(table3(run_set([sphere], protocol="sphere")))
    assert "| + DAGD + DAOM + M | 0.800 | 25.00 | 0.200 |" in text and "paper" not in text.split("- 360Roam")[0]


def test_a_row_for_each_rung_with_what_it_costs():
    rungs = [replace(small(24 + i, 1 + i), variant=variant) for i, variant in enumerate(RUNGS)]
    text = markdown(ladder(run_set([*rungs[:3], result("full")])))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| A")]
    assert [row[0][:2] for row in rows] == [f"A{i}" for i in range(7)]
    assert [row[2] for row in rows] == ["24.00", "<ins>25.00</ins>", "**26.00**", "–", "–", "–", "–"]
    assert [row[4] for row in rows][:3] == ["50000", "100000", "150000"]


def test_without_a_ladder_there_is_no_block():
    assert ladder(run_set([result("full")])).blocks == ()


def test_times_of_two_machines_are_not_compared():
    rungs = [replace(small(24 + i), variant=variant) for i, variant in enumerate(("a0_pano_3dgs", "a1_anchors"))]
    with pytest.raises(ReportError, match="differ in machine"):
        ladder(run_set([rungs[0], replace(rungs[1], machine={"gpu": "H200"})]))


def quirky(**psnr: float):
    return [
        replace(small(value), variant=variant, run=variant, experiments=("deviations",))
        for variant, value in psnr.items()
    ]


def test_each_quirk_beside_the_method_as_described():
    table = quirks(run_set(quirky(odgs=25.0, odgs_bias=24.25, odgs_all=22.0, padgs=26.0)))
    assert [block.title.partition(",")[0] for block in table.blocks] == ["ODGS", "PaD-GS"]
    change = [column.title for column in table.columns].index("Δ")
    found = {row.title: row.cells[change].value for row in table.blocks[0].rows}
    assert found["as described"] == 0 and found["half a pixel off"] == pytest.approx(-0.75)
    assert found["as released"] == pytest.approx(-3) and found["extent + 100"] is None
    assert quirks(run_set([small(25)])).blocks == ()


def test_what_was_measured_otherwise_does_not_stand_beside():
    first, second = quirky(odgs=25.0, odgs_bias=24.25)
    with pytest.raises(ReportError, match="differ in length"):
        quirks(run_set([first, replace(second, iterations=7)]))
