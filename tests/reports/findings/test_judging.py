import math
from dataclasses import replace
from statistics import stdev

import hypothesis
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_up import gathered, of_experiment
from scipy.stats import ttest_1samp

from padgs.reports import published
from padgs.reports.findings.judging import NEGLIGIBLE, Claim, Side, Verdict, in_the_paper, judge
from padgs.reports.methods import title
from padgs.reports.tables.ranking import quantile

PADGS = Side(("padgs",), published=("padgs",))
RIVALS = Side(("omnigs", "spags"), published=("omnigs", "spags"))


def claim(ours=PADGS, others=RIVALS, metric="paper/psnr", **more) -> Claim:
    return Claim("Table 1", "it is the best", metric, ours, others, ("order",), **more)


def runs(gains, preset="padgs", scene="synthetic-room", base=25.0, **others):
    """A run for each seed; what a seed adds is in all presets alike."""
    return [
        of_experiment("order@cpu", base + 3 * seed + gain, preset=preset, seed=seed, scene=scene, **others)
        for seed, gain in enumerate(gains)
    ]


def verdict(*made, of=None) -> Verdict:
    return judge(of or claim(), gathered([run for group in made for run in group])).verdict


@hypothesis.settings(max_examples=12)
@given(st.lists(st.integers(-40, 40).map(lambda n: n / 10), min_size=3, max_size=6).filter(lambda g: len(set(g)) > 1))
def test_one_scene_with_one_rival_is_a_paired_t_test(gains):
    made = judge(claim(), gathered([*runs(gains), *runs([0] * len(gains), "omnigs")]))
    (line,) = made.lines
    assert line.advantage.value == pytest.approx(sum(gains) / len(gains))
    interval = ttest_1samp(gains, 0).confidence_interval(0.95)
    assert line.half_width == pytest.approx((interval.high - interval.low) / 2)
    decided = abs(line.advantage.value) > line.half_width
    right = line.advantage.value > 0
    open_or_tie = Verdict.TIE if line.half_width <= NEGLIGIBLE else Verdict.UNDECIDED
    assert made.verdict == ((Verdict.HOLDS if right else Verdict.FAILS) if decided else open_or_tie)


def test_scenes_decide_together_and_may_disagree():
    better, worse, same = [1, 1.1, 0.9], [-1, -1.1, -0.9], [0.1, -0.1, 0]
    rival = [*runs([0] * 3, "omnigs"), *runs([0] * 3, "omnigs", "flat")]
    assert verdict(runs(better), runs(same, scene="flat"), rival) is Verdict.HOLDS
    assert verdict(runs(worse), runs(same, scene="flat"), rival) is Verdict.FAILS
    assert verdict(runs(worse), runs(better, scene="flat"), rival) is Verdict.MIXED
    assert verdict(runs(same), runs(same, scene="flat"), rival) is Verdict.TIE


def test_two_seeds_are_enough_on_two_scenes_and_too_few_on_one():
    pair, rival = [1, 1.1], [0, 0]
    assert verdict(runs(pair), runs(rival, "omnigs")) is Verdict.UNDECIDED
    assert verdict(runs(pair), runs(rival, "omnigs"), runs(pair, scene="flat"), runs(rival, "omnigs", "flat")) is (
        Verdict.HOLDS
    )


def test_the_best_rival_counts_and_many_of_them_widen_the_interval():
    made = [*runs([1, 1.1, 0.9]), *runs([0] * 3, "omnigs")]
    alone = judge(claim(), gathered(made)).lines[0]
    (line,) = judge(claim(), gathered([*made, *runs([0.5] * 3, "spags")])).lines
    assert (line.rivals, line.against) == (2, title("spags")) and line.advantage.value == pytest.approx(0.5)
    assert line.half_width > alone.half_width
    assert judge(claim(), gathered([*made, *runs([0.5] * 3, "odgs")])).lines == (alone,), "no rival of this claim"


def test_every_scene_is_a_test_of_its_own():
    gains, scenes = [1, 1.1, 0.9], ("synthetic-room", "flat")
    made = [run for scene in scenes for run in (*runs(gains, scene=scene), *runs([0] * 3, "omnigs", scene))]
    for line in judge(claim(), gathered(made)).lines:
        assert line.half_width == pytest.approx(quantile(freedom=4, tests=2) * stdev(gains) / math.sqrt(3))


def test_what_cannot_be_compared_hides_nothing():
    made = [*runs([1, 1.1, 0.9]), *runs([0] * 3, "omnigs")]
    other = of_experiment("order@cpu", 40, preset="spags", seed=7)
    assert judge(claim(), gathered([*made, other])).lines[0].against == title("omnigs"), "a rival without our seeds"
    longer = [*runs([1] * 3, iterations=7000), *runs([0] * 3, "omnigs", iterations=7000)]
    failed = [replace(run, status="oom", scores={}) for run in longer[:3]]
    (line,) = judge(claim(), gathered([*made, *failed, *longer[3:]])).lines
    assert "1500" in line.where, "a length that only one side reached"


def test_lower_is_better_where_the_metric_says_so():
    made = [*runs([1, 1.1, 0.9]), *runs([0] * 3, "omnigs")]  # made-up LPIPS falls with PSNR
    assert judge(claim(metric="paper/lpips_vgg_01"), gathered(made)).verdict is Verdict.HOLDS


def test_costs_are_compared_by_their_quotient():
    timed = [
        of_experiment("order", 25, preset=preset, seed=seed, timing={"cpu_seconds": seconds * (1 + 0.01 * seed)})
        for preset, seconds in (("padgs", 30), ("omnigs", 60))
        for seed in range(3)
    ]
    (line,) = judge(claim(metric="cpu_seconds"), gathered(timed)).lines
    assert math.exp(line.advantage.value) == pytest.approx(2)


def test_the_longest_runs_of_a_scene_count_and_other_experiments_do_not():
    short = [*runs([-1, -1.1, -0.9]), *runs([0] * 3, "omnigs")]
    long = [*runs([1, 1.1, 0.9], iterations=7000), *runs([0] * 3, "omnigs", iterations=7000)]
    assert verdict(short) is Verdict.FAILS and verdict(short, long) is Verdict.HOLDS
    alone = runs([0] * 3, "omnigs", iterations=30_000)
    assert verdict(short, long, alone) is Verdict.HOLDS, "nothing to compare it with"
    elsewhere = [of_experiment("length", 20 + seed, preset="padgs", seed=seed, iterations=9000) for seed in range(3)]
    assert verdict(long, elsewhere) is Verdict.HOLDS


def test_one_long_run_is_judged_by_the_spread_of_short_ones():
    short = [*runs([-1, -1.1, -0.9]), *runs([0] * 3, "omnigs")]
    long = [*runs([1], iterations=7000), *runs([0], "omnigs", iterations=7000)]
    assert verdict(long) is Verdict.UNDECIDED
    (line,) = judge(claim(), gathered([*short, *long])).lines
    (three,) = judge(claim(), gathered(short)).lines
    assert "7000" in line.where and line.advantage.value == pytest.approx(1)
    assert line.half_width == pytest.approx(math.sqrt(3) * three.half_width)


def test_sides_are_told_apart_by_keys_and_meet_where_columns_agree():
    made = [
        run
        for preset, base in (("padgs", 30.0), ("padgs_small", 20.0))
        for tau, gain in ((0.9, -2.0), (0.0, 0.0))
        for run in runs([gain, gain + 0.1], preset, base=base, options={"tau": tau})
    ]
    dimmed, plain = (Side(("padgs", "padgs_small"), keys={"method.tau": tau}) for tau in (0.9, 0.0))
    found = judge(claim(dimmed, plain, apart=("preset",)), gathered(made))
    assert found.verdict is Verdict.FAILS and len(found.lines) == 2
    assert [line.advantage.value for line in found.lines] == pytest.approx([-2, -2])
    best = Side(("padgs",), keys={"method.tau": 0.9})
    (line,) = judge(claim(best, Side(("padgs",))), gathered(made)).lines
    assert line.rivals == 1, "its own runs are no rivals"


def test_without_runs_it_is_not_measured_and_of_a_data_set_not_testable():
    assert verdict() is Verdict.UNMEASURED
    assert verdict(runs([1, 2, 3])) is Verdict.UNMEASURED
    assert verdict(runs([1, 1, 1]), runs([0] * 3, "omnigs"), of=claim(dataset="roam360")) is Verdict.UNTESTABLE
    assert verdict(runs([1, 1, 1]), runs([0] * 3, "omnigs"), of=claim(outdoor=True)) is Verdict.UNMEASURED


def test_the_papers_numbers_are_compared_in_the_same_way():
    numbers, where = published.load(), ((1, "roam360", "average"),)
    assert in_the_paper(claim(published=where, published_metric="psnr"), numbers) == {
        "360Roam, average": pytest.approx(26.02 - 24.90)
    }
    times = claim(metric="cpu_seconds", published=((4, "roam360", "average"),), published_metric="train_hours")
    assert math.exp(in_the_paper(times, numbers)["360Roam, average"]) == pytest.approx(0.43 / 1.35)
