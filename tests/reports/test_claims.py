import math
from dataclasses import replace

import hypothesis
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ttest_rel
from support.made_up import of_experiment, run_set

from padgs.reports import published
from padgs.reports.claims import (
    FAILS,
    HOLDS,
    MIXED,
    UNDECIDED,
    UNMEASURED,
    Claim,
    evaluate,
    findings,
    in_the_paper,
    load,
)
from padgs.reports.methods import title

SCENES = ("synthetic-room", "flat", "bedroom")
BETTER, WORSE, SAME = [1, 1.1, 0.9], [-1, -1.1, -0.9], [0.1, -0.1, 0]


def claim(**changes) -> Claim:
    made = Claim("it is the best", "Table 1", "order", "paper/psnr", ["padgs"], ["omnigs", "spags"])
    return replace(made, **changes)


def runs(gains, preset="padgs", scene="synthetic-room", base=25.0, **others):
    """A run for each seed; a seed adds the same to all presets."""
    return [
        of_experiment("order@cpu", base + 3 * seed + gain, preset=preset, seed=seed, scene=scene, **others)
        for seed, gain in enumerate(gains)
    ]


def against(*gains, **others):
    """Runs of PaD-GS with gains over OmniGS on some scenes."""
    return [
        run
        for scene, own in zip(SCENES, gains, strict=False)
        for run in (*runs(own, scene=scene, **others), *runs([0] * len(own), "omnigs", scene, **others))
    ]


def verdict(made, **changes) -> str:
    return evaluate(claim(**changes), run_set(made)).verdict


@hypothesis.settings(max_examples=12, deadline=None)
@given(st.lists(st.integers(-40, 40).map(lambda n: n / 10), min_size=2, max_size=6).filter(lambda g: len(set(g)) > 1))
def test_one_scene_is_a_paired_t_test_over_seeds(gains):
    evidence = evaluate(claim(), run_set(against(gains)))
    expected = ttest_rel(gains, [0] * len(gains)).confidence_interval(0.95)
    assert evidence.interval == pytest.approx((expected.low, expected.high), abs=1e-6)
    assert evidence.pairs["advantage"].to_list() == pytest.approx(gains)
    decided = HOLDS if expected.low > 0 else FAILS if expected.high < 0 else UNDECIDED
    assert evidence.verdict == decided


def test_three_scenes_are_the_units():
    evidence = evaluate(claim(), run_set(against(BETTER, [2, 2.2, 1.8], [3, 3])))
    expected = ttest_rel([1, 2, 3], [0, 0, 0]).confidence_interval(0.95)
    assert evidence.interval == pytest.approx((expected.low, expected.high))


def test_scenes_decide_together():
    assert verdict(against(BETTER, BETTER)) == HOLDS and verdict(against(WORSE, WORSE)) == FAILS
    assert verdict(against(WORSE, BETTER)) == MIXED and verdict(against([0.1, -0.2, 0.2])) == UNDECIDED
    assert verdict(against([1])) == UNDECIDED, "one pair has no interval"
    assert verdict([]) == UNMEASURED == verdict(runs(BETTER))
    assert verdict(against(BETTER), scenes="outdoor") == UNMEASURED


def test_the_best_rival_counts_and_many_widen_the_interval():
    alone = evaluate(claim(), run_set(against(BETTER)))
    both = evaluate(claim(), run_set([*against(BETTER), *runs([0.5] * 3, "spags")]))
    assert set(both.pairs["rival"]) == {title("spags")}
    assert both.pairs["advantage"].mean() == pytest.approx(0.5)
    assert alone.interval and both.interval
    assert both.interval[1] - both.interval[0] > alone.interval[1] - alone.interval[0]
    other = evaluate(claim(), run_set([*against(BETTER), *runs([0.5] * 3, "odgs")]))
    assert other.interval == alone.interval, "no rival of this claim"


def test_only_comparable_runs_count():
    made, long = against(BETTER), against(WORSE, iterations=7000)
    assert verdict([*made, *long]) == FAILS, "the longest"
    failed = [replace(run, status="oom", scores={}) for run in long[:3]]
    assert verdict([*made, *failed, *long[3:]]) == HOLDS, "a length that only one side reached"
    assert verdict([*made, *runs([9] * 3, "omnigs", iterations=7000)]) == HOLDS
    assert verdict([*made, of_experiment("order", 40, preset="spags", seed=7)]) == HOLDS, "a rival without our seeds"
    assert verdict([*made, *(of_experiment("length", 9, seed=seed, iterations=9000) for seed in range(3))]) == HOLDS


def test_lower_is_better_where_the_metric_says_so():
    assert verdict(against(BETTER), metric="paper/lpips_vgg_01") == HOLDS, "made-up LPIPS falls with PSNR"


def test_costs_are_compared_by_their_ratio():
    timed = [
        of_experiment("order", 25, preset=preset, seed=seed, timing={"cpu_seconds": seconds})
        for preset, times in (("padgs", (30, 30.3, 30.6)), ("omnigs", (60, 60, 60)))
        for seed, seconds in enumerate(times)
    ]
    evidence = evaluate(claim(metric="cpu_seconds"), run_set(timed))
    assert evidence.pairs["advantage"].map(math.exp).to_list() == pytest.approx([2, 2 / 1.01, 2 / 1.02])


def test_sides_are_told_apart_by_keys_and_meet_where_columns_agree():
    made = [
        run
        for preset, base in (("padgs", 30.0), ("padgs_small", 20.0))
        for tau, gain in ((0.9, -2.0), (0.0, 0.0))
        for run in runs([gain, gain + 0.1 * (tau > 0)], preset, base=base, options={"tau": tau})
    ]
    modulated, plain = ({"presets": ["padgs", "padgs_small"], "keys": {"method.tau": tau}} for tau in (0.9, 0.0))
    evidence = evaluate(claim(ours=modulated, others=plain, within=("preset",)), run_set(made))
    assert evidence.pairs["advantage"].to_list() == pytest.approx([-2, -1.9] * 2)
    own = evaluate(claim(ours={"presets": ["padgs"], "keys": {"method.tau": 0.9}}, others=["padgs"]), run_set(made))
    assert len(own.pairs) == 2, "its own runs are no rivals"


def test_published_numbers_are_compared_likewise():
    numbers = published.load()
    made = claim(published=[(1, "roam360", "average")], published_metric="psnr")
    assert in_the_paper(made, numbers) == {"360Roam, average": pytest.approx(26.02 - 24.90)}
    times = replace(made, metric="cpu_seconds", published=[(4, "roam360", "average")], published_metric="train_hours")
    assert math.exp(in_the_paper(times, numbers)["360Roam, average"]) == pytest.approx(0.43 / 1.35)


def test_the_paper_says_what_is_claimed():
    for one in load():
        found = in_the_paper(one, published.load())
        assert len(found) == len(one.published) and all(value > 0 for value in found.values()), one.text


def test_the_page_has_the_answer_first_and_a_row_for_each_claim():
    made = [replace(run, experiments=("equal_time",)) for run in against(WORSE, WORSE)]
    for of in (run_set([]), run_set(made)):
        rows = [line for line in findings(of).text.splitlines() if line.startswith("| ")][2:]
        assert [row.split(" | ")[0].strip("| ") for row in rows] == [one.text for one in load()]
    answer, evidence = findings(run_set(made)).text.split("## Evidence")
    assert "1 do not" in answer and "**Does not hold:**\n\n- PaD-GS has the best PSNR after equal" in answer
    assert "| Sec. 4.5 | PSNR | -1.00 | -1.09 to -0.91 | 0 of 2 scenes | OmniGS, corrected |" in evidence
