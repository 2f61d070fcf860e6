from dataclasses import replace

import pytest
from support.made_up import failed, of_experiment, run_set

from padgs.data.perturb import CONDITIONS
from padgs.reports.page import page
from padgs.reports.robustness import LIMITS, LIMITS_ARE_FOR, STATUS_LETTERS, limits, stability
from padgs.reports.table import ReportError
from padgs.reports.writers import latex, markdown
from padgs.results import STATUSES, Scores

RULES = {"name": "stability", "lpips": "none", "lpips_inputs": "11", "bottom_crop": 0.0}
WIDTH, HEIGHT = map(int, LIMITS_ARE_FOR[0].split("x"))
OMNIGS = "OmniGS, corrected"


def run(preset: str, quality: float, condition: str = "", level: int = 0, seed: int = 0, status: str = "ok", **metrics):
    made = of_experiment("stress@cpu", quality, preset=preset, seed=seed, iterations=LIMITS_ARE_FOR[1])
    metrics = {"ws_psnr_one_color": 12.0, "seam": 1.0, "depth_error": 0.05, "ws_psnr": quality} | metrics
    metrics = {"ws_psnr_training": quality + 1} | metrics
    stress = {"stress": {"condition": condition, "level": level}} if condition else {}
    return replace(
        made,
        run=f"{made.run}_{condition}_{level}",
        variant=f"{condition} {level}" if condition else "",
        width=WIDTH,
        height=HEIGHT,
        config=made.config | stress,
        scores={"stability": Scores(RULES, metrics, {"a": metrics})} if status == "ok" else {},
        status=status,
    )


def runs(seed: int = 0):
    return [
        run("omnigs", 22.0, seed=seed),  # 10 dB above one colour
        run("omnigs", 21.0, "pose_noise", 1, seed),
        run("omnigs", 16.0, "pose_noise", 2, seed),
        run("omnigs", 0.0, "seam", 1, seed, "diverged"),
        run("omnigs", 30.0, "seam", 2, seed),
        run("padgs", 32.0, seed=seed),
        run("padgs", 22.4, "pose_noise", 1, seed),
        run("padgs", 22.6, "seam", 2, seed),
    ]


MISSING = [run("padgs", 22.0, "pose_noise", 2), run("padgs", 24.0, "seam", 1)]  # conditions that `runs` lack of PaD-GS


def cells(table, title: str) -> dict[str, dict[str, str]]:
    (block,) = (block for block in table.blocks if block.title.startswith(title))
    heads = [column.title for column in table.columns]
    return {row.title: dict(zip(heads, row.texts(table.columns)[1:], strict=True)) for row in block.rows}


def losses(*made) -> dict[str, dict[str, str]]:
    return cells(limits(run_set(list(made))), "synthetic-room")


def test_robustness_is_the_share_above_one_colour():
    kept = cells(stability(run_set(runs()))[0], "Robustness")
    assert list(kept) == ["pose_noise 1", "pose_noise 2", "seam 1", "seam 2"]
    assert kept["pose_noise 1"] == {"PaD-GS": "0.52", OMNIGS: "0.90"}
    assert kept["pose_noise 2"] == {"PaD-GS": "–", OMNIGS: "0.40"}
    assert kept["seam 1"] == {"PaD-GS": "–", OMNIGS: "0.00 [DIVERGED]"}
    assert kept["seam 2"][OMNIGS] == "1.00", "at most 1"


def test_nothing_is_kept_of_a_reference_below_one_colour():
    made = [run("padgs", 11.0), run("padgs", 9.0, "seam", 1), run("padgs", 20.0, "seam", 2)]
    table, *_ = stability(run_set(made))
    assert {of["PaD-GS"] for of in cells(table, "Robustness").values()} == {"–"}
    assert cells(table, "Breaks at level")["seam"]["PaD-GS"] == "–"
    assert cells(table, "synthetic-room")["stability score"]["PaD-GS"] == "–"


def test_scores_and_breakdowns():
    table, *_ = stability(run_set([*runs(), *MISSING]))
    scores, breaks = cells(table, "synthetic-room"), cells(table, "Breaks at level")
    omnigs = {row: of[OMNIGS] for row, of in scores.items()}
    # Pose noise keeps (0.9 + 0.4) / 2, the seam (0 + 1) / 2; the worst quarter of two conditions is one.
    assert (omnigs["stability score"], omnigs["worst quartile"], omnigs["failure rate"]) == ("0.57", "0.50", "0.25")
    assert omnigs["unstressed: training views above test views, dB"] == "1.00"
    assert "unstressed: floaters" not in omnigs, "no run has this metric"
    assert breaks == {"pose_noise": {"PaD-GS": "–", OMNIGS: "2"}, "seam": {"PaD-GS": "–", OMNIGS: "1"}}
    assert [column.title for column in table.columns] == ["PaD-GS", OMNIGS]
    assert scores["worst quartile"]["PaD-GS"] == "0.51", "pose noise keeps (0.52 + 0.5) / 2, the seam 0.57"


@pytest.mark.parametrize(("oracle", "row"), [({"pole_gap_oracle": 1.5}, "2.50"), ({"pole_gap_oracle": None}, None)])
def test_the_pole_gap_is_shown_with_that_of_the_scene(oracle, row):
    measured = run("omnigs", 22.0, ws_psnr_equator=25.0, ws_psnr_pole=21.0, **oracle)
    scores = cells(stability(run_set([measured, *runs()[1:]]))[0], "synthetic-room")
    assert scores["unstressed: equator above poles, dB"] == {"PaD-GS": "–", OMNIGS: "4.00"}
    assert scores.get("unstressed: the same, above a truth blurred alike, dB", {}).get(OMNIGS) == row


def test_an_incomplete_method_has_no_score_and_stands_last():
    for incomplete in (runs(), [*runs(), MISSING[0]]):
        table, _ = stability(run_set(incomplete))
        assert [column.title for column in table.columns] == [OMNIGS, "PaD-GS"]
        scores = cells(table, "synthetic-room")
        for row in ("stability score", "worst quartile", "failure rate"):
            assert scores[row]["PaD-GS"] == "–" != scores[row][OMNIGS]
        assert scores["unstressed: WS-PSNR, dB"]["PaD-GS"] == "32.00"


def test_some_conditions_are_shown_but_not_scored():
    both = [*runs(), *MISSING]
    shown = [run("padgs", 12.0, "textureless", 1), run("padgs", 12.0, "textureless", 2, status="rejected")]
    with_it, without = (cells(stability(run_set(of))[0], "synthetic-room") for of in ([*both, *shown], both))
    assert with_it == without
    kept = cells(stability(run_set([*both, *shown]))[0], "Robustness")
    assert kept["textureless 1"]["PaD-GS"] == "0.00" and kept["textureless 2"]["PaD-GS"] == "0.00 [REJECTED]"


def test_a_stopped_run_is_neither_a_seed_nor_a_reference():
    names = ("stopped after 9 iterations", "pose_noise 1, stopped after 9 iterations")
    stopped = [replace(one, run="stopped", seed=9, variant=name) for one, name in zip(runs(), names, strict=False)]
    assert stability(run_set([*runs(), *stopped]))[0] == stability(run_set(runs()))[0]


def test_a_method_whose_run_without_stress_failed_is_named():
    lost = [run("spags", 0.0, status="diverged"), run("spags", 20.0, "pose_noise", 1), run("spags", 20.0, "seam", 1)]
    of = run_set([*runs(), *lost])
    stability(of)
    assert (
        "synthetic-room" in of.warnings[0] and "SPaGS is left out, for it has no run without stress" in of.warnings[0]
    )


def test_seeds_are_compared_with_their_own_reference():
    _, *others = runs(seed=1)
    table, *_ = stability(run_set([*runs(), run("omnigs", 17.0, seed=1), *others]))
    assert cells(table, "Robustness")["pose_noise 2"][OMNIGS] == "0.60 ± 0.28", "4 of 10, and 4 of 5"


def test_runs_that_differ_in_more_are_refused():
    other = runs()[1]
    other = replace(other, run="other", config=other.config | {"method": {"tau": 0.1}})
    with pytest.raises(ReportError, match=r"differ in method.tau"):
        stability(run_set([*runs(), other]))


def test_every_status_has_a_letter_of_its_own():
    assert set(STATUS_LETTERS) == set(STATUSES) - {"ok"} and len(set(STATUS_LETTERS.values())) == len(STATUS_LETTERS)


def test_files_and_page():
    complete = [
        run("spags", 22.0),
        run("spags", 0.0, "pose_noise", 2, status="diverged"),
        run("spags", 20.0, "seam", 2),
    ]
    table, heat_map = stability(run_set([*runs(), *complete]))
    assert heat_map.name == "stability-synthetic-room-256x128"
    assert ">.40<" in heat_map.svg and ">V<" in heat_map.svg and ">.52<" not in heat_map.svg, "level 2"
    assert "V diverged" in heat_map.svg and "exploded" not in heat_map.svg and heat_map.png.startswith(b"\x89PNG")
    assert "left out: PaD-GS." in heat_map.notes[-1]
    assert "| 0.00 \\[DIVERGED\\] |" in markdown(table) and "DIVERGED" in latex(table)
    html = page.html(run_set(runs()))
    assert 'id="stability"' in html and 'id="heat_maps"' in html


def test_losses_stand_beside_their_limits():
    noise = (("pose_noise", 1, 21.6), ("pose_noise", 2, 19.5), ("jpeg", 1, 22.5))
    lost = losses(run("omnigs", 22.0), *(run("omnigs", value, *stress) for *stress, value in noise))
    assert lost["pose_noise 1, dB"] == {"allowed": "0.50", OMNIGS: "0.40"}
    assert lost["pose_noise 2, dB"] == {"allowed": "2.00", OMNIGS: "2.50 [BEYOND]"}
    assert lost["jpeg 1, dB"] == {"allowed": "–", OMNIGS: "-0.50"}


def test_some_conditions_have_another_metric():
    lost = losses(
        run("omnigs", 22.0, ws_psnr_fitted=23.0),
        run("omnigs", 12.5, "exposure", 1, ws_psnr_fitted=22.7),
        run("omnigs", 22.0, "seam", 1, seam=1.2),
        run("omnigs", 12.0, "textureless", 1, depth_error=0.09),
    )
    assert lost["exposure 1, dB after a fit of colours"][OMNIGS] == "0.30"
    assert lost["seam 1, seam"] == {"allowed": "1.10", OMNIGS: "1.20 [BEYOND]"}
    assert lost["textureless 1, depth error"][OMNIGS] == "0.09"
    unknown = losses(run("omnigs", 22.0), run("omnigs", 12.5, "exposure", 1))
    assert unknown["exposure 1, dB after a fit of colours"][OMNIGS] == "–"


def test_losses_of_seeds_and_of_failed_runs():
    lost = losses(
        run("omnigs", 22.0),
        run("omnigs", 24.0, seed=1),
        run("omnigs", 21.0, "seam", 1, status="diverged"),
        run("omnigs", 21.0, "pose_noise", 1),
        run("omnigs", 23.8, "pose_noise", 1, 1),
    )
    assert lost["pose_noise 1, dB"][OMNIGS] == "0.60 ± 0.57 [BEYOND]"
    assert lost["seam 1, seam"][OMNIGS] == "DIVERGED"


@pytest.mark.parametrize("other", [{"width": 128, "height": 64}, {"iterations": 250}])
def test_other_sizes_and_lengths_have_no_limits(other):
    assert limits(run_set([replace(one, **other) for one in runs()[:2]])).blocks == ()


def test_without_stress_there_are_no_tables():
    assert limits(run_set([failed("", "oom")])).blocks == () == stability(run_set([failed("", "oom")]))[0].blocks


def test_limits_are_those_of_the_conditions():
    read = {name: (limit.get("metric", "ws_psnr"), limit.get("allowed", ())) for name, limit in LIMITS.items()}
    assert read == {name: (condition.metric, condition.allowed) for name, condition in CONDITIONS.items()}


def test_scores_by_other_rules_are_not_mixed():
    first, *others = runs()
    cropped = replace(first.scores["stability"], protocol={**RULES, "bottom_crop": 0.25})
    with pytest.raises(ReportError, match="differ in stability rules"):
        stability(run_set([replace(first, scores={"stability": cropped}), *others]))
