from dataclasses import replace

import pytest
from made_up import failed, of_experiment, run_set

from padgs.reports.charts.robustness_chart import STATUS_LETTERS
from padgs.reports.frame import frame
from padgs.reports.page import page
from padgs.reports.robustness import stability, stressed_methods
from padgs.reports.selection import RunSet
from padgs.reports.store import Run
from padgs.reports.table import ReportError
from padgs.reports.writers import latex, markdown
from padgs.results import STATUSES, Scores, picture_name

RULES = {"name": "stability", "lpips": "none", "lpips_inputs": "11", "bottom_crop": 0.0}
ONE_COLOR = 12.0


def run(preset: str, quality: float, condition: str = "", level: int = 0, seed: int = 0, status: str = "ok"):
    made = of_experiment("stress@cpu", quality, preset=preset, seed=seed)
    marks = {"ws_psnr": quality, "ws_psnr_one_color": ONE_COLOR, "ws_psnr_training": quality + 1, "seam": 1.1}
    stress = {"stress": {"condition": condition, "level": level}} if condition else {}
    return replace(
        made,
        run=f"{made.run}_{condition}_{level}",
        variant=f"{condition} {level}" if condition else "",
        config=made.config | stress,
        scores={"stability": Scores(RULES, marks, {"a": marks})} if status == "ok" else {},
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


def rest():
    """What `runs` spare PaD-GS."""
    return [run("padgs", 22.0, "pose_noise", 2), run("padgs", 24.0, "seam", 1)]


def cells(table, title: str) -> dict[str, dict[str, str]]:
    (block,) = (block for block in table.blocks if block.title.startswith(title))
    heads = [column.title for column in table.columns]
    return {row.title: dict(zip(heads, row.texts(table.columns)[1:], strict=True)) for row in block.rows}


def test_what_is_kept_is_the_share_above_one_colour():
    table, *_ = stability(run_set(runs()))
    kept = cells(table, "Robustness")
    assert kept["pose_noise 1"] == {"PaD-GS": "0.52", "OmniGS, corrected": "0.90"}
    assert kept["pose_noise 2"] == {"PaD-GS": "–", "OmniGS, corrected": "0.40"}
    assert kept["seam 1"] == {"PaD-GS": "–", "OmniGS, corrected": "0.00 [DIVERGED]"}
    assert kept["seam 2"]["OmniGS, corrected"] == "1.00"  # more than all is all
    assert list(kept) == ["pose_noise 1", "pose_noise 2", "seam 1", "seam 2"]


def test_scores_and_where_it_breaks():
    table, *_ = stability(run_set([*runs(), *rest()]))
    scores, breaks = cells(table, "synthetic-room"), cells(table, "Breaks at level")
    # OmniGS: pose noise keeps (0.9 + 0.4) / 2, the seam (0 + 1) / 2; the worst quarter of two conditions is one
    omnigs = {row: of["OmniGS, corrected"] for row, of in scores.items()}
    assert (omnigs["stability score"], omnigs["worst quartile"], omnigs["failure rate"]) == ("0.57", "0.50", "0.25")
    assert omnigs["unstressed: training views above test views, dB"] == "1.00"
    assert "unstressed: floaters" not in omnigs, "what no run of the scene was measured by"
    assert breaks == {
        "pose_noise": {"PaD-GS": "–", "OmniGS, corrected": "2"},
        "seam": {"PaD-GS": "–", "OmniGS, corrected": "1"},
    }
    assert [column.title for column in table.columns] == ["PaD-GS", "OmniGS, corrected"]
    assert scores["worst quartile"]["PaD-GS"] == "0.51"  # pose noise keeps (0.52 + 0.5) / 2, the seam 0.57


def test_the_pole_gap_is_told_with_what_the_scene_itself_has_of_it():
    gap = {"ws_psnr_equator": 25.0, "ws_psnr_pole": 21.0}
    for oracle, row in (({"pole_gap_oracle": 1.5}, "2.50"), ({"pole_gap_oracle": None}, None), ({}, None)):
        first, *others = runs()
        marks = first.scores["stability"].metrics | gap | oracle
        measured = replace(first, scores={"stability": Scores(RULES, marks, {"a": marks})})
        scores = cells(stability(run_set([measured, *others]))[0], "synthetic-room")
        assert scores["unstressed: equator above poles, dB"] == {"PaD-GS": "–", "OmniGS, corrected": "4.00"}
        beyond = scores.get("unstressed: the same, above a truth blurred alike, dB")
        assert (beyond and beyond["OmniGS, corrected"]) == row


def test_who_was_spared_something_has_no_score_and_stands_last():
    for spared in (runs(), [*runs(), rest()[0]]):
        table, _, chart = stability(run_set(spared))
        assert [column.title for column in table.columns] == ["OmniGS, corrected", "PaD-GS"]
        scores = cells(table, "synthetic-room")
        for row in ("stability score", "worst quartile", "failure rate"):
            assert scores[row]["PaD-GS"] == "–" != scores[row]["OmniGS, corrected"]
        assert scores["unstressed: WS-PSNR, dB"]["PaD-GS"] == "32.00" and "score –, worst quartile –" in chart.svg


def test_what_means_nothing_to_some_methods_is_told_and_neither_scored_nor_counted():
    both = [*runs(), *rest()]
    told = [run("padgs", 12.0, "precision", 1)]  # PaD-GS alone has networks
    told.append(replace(run("padgs", 12.0, "capacity", 1), status="rejected"))  # and cannot be told a number
    with_it, without = (cells(stability(run_set(of))[0], "synthetic-room") for of in ([*both, *told], both))
    assert with_it == without
    kept = cells(stability(run_set([*both, *told]))[0], "Robustness")
    assert kept["precision 1"]["PaD-GS"] == "0.00" and kept["capacity 1"]["PaD-GS"] == "0.00 [REJECTED]"


def test_a_run_that_was_stopped_is_neither_a_seed_nor_a_reference():
    names = ("stopped after 9 iterations", "pose_noise 1, stopped after 9 iterations")
    stopped = [replace(one, run="stopped", seed=9, variant=name) for one, name in zip(runs(), names, strict=False)]
    assert stability(run_set([*runs(), *stopped]))[0] == stability(run_set(runs()))[0]


def test_files_of_scenes_of_two_data_sets_have_names_of_their_own():
    made = [replace(one, scene="room", dataset=dataset) for dataset in ("", "omniblender") for one in runs()]
    assert [one.place for one, *_ in stressed_methods(run_set(made)).values()] == [
        "room-512x256",
        "room_omniblender-512x256",
    ]


def test_seeds_are_compared_with_their_own():
    first, *others = runs(seed=1)
    lower = replace(first, scores={"stability": Scores(RULES, {"ws_psnr": 17.0, "ws_psnr_one_color": 12.0}, {})})
    table, *_ = stability(run_set([*runs(), lower, *others]))
    assert cells(table, "Robustness")["pose_noise 2"]["OmniGS, corrected"] == "0.60 ± 0.28"  # 4 of 10, and 4 of 5


def test_runs_that_differ_in_more_are_refused():
    other = runs()[1]
    other = replace(other, run="other", config=other.config | {"method": {"tau": 0.1}})
    with pytest.raises(ReportError, match=r"differ in method.tau"):
        stability(run_set([*runs(), other]))


def test_every_outcome_has_a_letter_of_its_own():
    assert set(STATUS_LETTERS) == set(STATUSES) - {"ok"} and len(set(STATUS_LETTERS.values())) == len(STATUS_LETTERS)


def test_it_is_written_and_stands_on_the_page():
    table, chart, survival = stability(run_set(runs()))
    assert chart.name == "stability-synthetic-room-512x256"
    assert "pose_noise 2: keeps 0.40; WS-PSNR 16.00 dB, 22.00 without" in chart.svg and ">V<" in chart.svg
    assert "V diverged" in chart.svg and "exploded" not in chart.svg and chart.png.startswith(b"\x89PNG")
    assert chart.numbers is not None and len(chart.numbers) == 6
    assert survival.numbers is not None and survival.name == "robustness-synthetic-room-512x256"
    assert dict(survival.numbers.set_index("preset")["score"])["omnigs"] == pytest.approx(0.575)
    assert "| 0.00 [DIVERGED] |" in markdown(table) and "DIVERGED" in latex(table)
    html = page.html(run_set(runs()))
    assert 'id="stability"' in html and 'id="heat_maps"' in html


def test_the_name_of_a_condition_is_text_and_not_markup():
    evil = "</script><b-x>"
    made = [run("omnigs", 22.0), run("omnigs", 21.0, evil, 1)]
    table, *charts = stability(run_set(made))
    assert "<b-x>" not in markdown(table) and all("<b-x>" not in chart.svg for chart in charts)
    html = page.html(run_set(made))
    assert "<b-x>" not in html and "&lt;b-x&gt; 1" in html


def test_without_such_runs_there_is_nothing():
    (table,) = stability(run_set([failed("", "oom")]))
    assert table.blocks == ()


def test_a_cell_opens_the_picture_of_its_worst_view(tmp_path):
    made = run("omnigs", 16.0, "pose_noise", 2)
    views = {name: {**made.scores["stability"].metrics, "ws_psnr": value} for name, value in (("a", 17.0), ("b", 15.0))}
    made = replace(made, scores={"stability": replace(made.scores["stability"], views=views)})
    for name in views:
        (tmp_path / picture_name(name)).touch()
    shown = [Run(run("omnigs", 22.0)), Run(made, pictures=tmp_path)]
    _, chart, _ = stability(RunSet(frame(shown)))
    assert (tmp_path / picture_name("b")).resolve().as_uri() in chart.svg
    assert (tmp_path / picture_name("a")).resolve().as_uri() not in chart.svg
    assert "opens its worst view" in chart.notes[1] and "file:" not in stability(run_set(runs()))[1].svg
