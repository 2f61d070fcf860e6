import math
from dataclasses import replace

import pytest
from scipy.stats import ttest_rel
from support.made_up import of_experiment, run_set

from padgs.reports import published
from padgs.reports.claims import (
    FAILS,
    HOLDS,
    MIXED,
    OURS,
    UNDECIDED,
    UNMEASURED,
    Claim,
    Evidence,
    findings,
    in_the_paper,
    judge,
    load,
)
from padgs.reports.methods import title
from padgs.reports.selection import Mixture
from padgs.reports.table import ReportError

SCENES = ("synthetic-room", "synthetic-cave", "synthetic-den", "synthetic-hut", "synthetic-loft", "synthetic-shed")
BETTER, WORSE = ([1, 1.1], [2, 2.1], [1.5, 1.4]), ([-1, -1.1], [-2, -2.1], [-1.5, -1.4])
NOT_REPRODUCED = "not reproduced at 512x256"


def claim(**changes) -> Claim:
    made = Claim("it is the best", "Table 1", "order", "paper/psnr", ["padgs"], ["omnigs", "spags"])
    return replace(made, **changes)


def runs(gains, preset="padgs", scene="synthetic-room", base=25.0, **others):
    """A run for each seed."""
    return [
        of_experiment("order@cpu", base + gain, preset=preset, seed=seed, scene=scene, **others)
        for seed, gain in enumerate(gains)
    ]


def against(*gains, seeds=2, **others):
    """Runs of PaD-GS with gains over OmniGS on some scenes."""
    return [
        run
        for scene, own in zip(SCENES, gains, strict=False)
        for run in (*runs(own, scene=scene, **others), *runs([0] * seeds, "omnigs", scene, **others))
    ]


def evidence(made, **changes) -> Evidence:
    (found,) = judge([claim(**changes)], run_set(made))
    return found


def verdict(made, **changes) -> str:
    return evidence(made, **changes).verdict


def test_scenes_are_the_units_of_a_paired_t_test_on_means_over_seeds():
    found = evidence(against([1, 1.2], [2, 2.4], [3, 3.6]))
    expected = ttest_rel([1.1, 2.2, 3.3], [0, 0, 0])
    assert found.interval == pytest.approx(tuple(expected.confidence_interval(0.95)))
    assert found.p == pytest.approx(expected.pvalue)


def test_a_scene_with_one_seed_of_a_side_is_listed_and_not_tested():
    for made in (against([1], [2], [3], seeds=1), against([1], [2], [3]), against(*BETTER, seeds=1)):
        found = evidence(made)
        assert (found.interval, found.verdict, len(found.scenes), len(found.tested)) == (None, UNDECIDED, 3, 0)
    third = [run for run in against([], [], [9], seeds=1) if run.scene == SCENES[2]]
    found = evidence([*against(*BETTER[:2]), *third])
    assert list(found.tested["scene"]) == ["synthetic-cave", "synthetic-room"] and found.verdict == UNDECIDED
    assert evidence(against(BETTER[0])).interval is None, "one scene"


def test_no_scene_is_lost_to_another_setting_and_no_copy_of_a_run_is_a_seed():
    first, *_ = made = against(*BETTER)
    other = replace(first, run="other", config={**first.config, "method": {"tau": 0.5}})
    with pytest.raises(ReportError, match="differ in method.tau; choose one with --where method.tau="):
        evidence([*made, other])
    rival = next(run for run in made if run.preset == "omnigs")
    with pytest.raises(ReportError, match="and copy are the same setting; delete one of them"):
        evidence([*made, replace(rival, run="copy")])


def test_verdicts():
    assert verdict(against(*BETTER)) == HOLDS and verdict(against(*WORSE)) == NOT_REPRODUCED
    assert verdict(against(*WORSE), source=OURS) == FAILS
    as_published = against(*WORSE, width=1920, height=960, iterations=30_000)
    assert verdict(as_published) == FAILS, "only at the paper's size and length"
    shorter = runs([-9, -9], "egonerf", width=1920, height=960, iterations=30_000)  # of its 100 000
    assert verdict([*as_published, *shorter], others=["omnigs", "egonerf"]) == FAILS, "it is not the best rival"
    assert verdict(against(WORSE[0], BETTER[0])) == MIXED and verdict(against([0.1, 0.1], [9, 9])) == UNDECIDED
    assert verdict(against([-2, 1.8], BETTER[0])) == UNDECIDED, "scenes disagree within the noise of seeds"
    assert verdict(against(*BETTER, *BETTER[1:], [-0.4, 0.3])) == HOLDS, (
        "a scene within the noise of seeds is no contradiction"
    )
    assert verdict(against(*BETTER, *BETTER[1:], [-0.05, -0.051])) == MIXED
    assert verdict([]) == UNMEASURED == verdict(runs([1, 2]))
    assert verdict(against(*BETTER), scenes="outdoor") == UNMEASURED


def test_scenes_not_tuned_on_decide_claims_of_our_own_alone_where_there_are_any():
    others = [
        replace(run, dataset="", scene=scene, fingerprint=data, run=f"{scene}{run.run}")
        for scene, data, gains in (("plaza", "da838962d5", BETTER[0]), ("basement", "76aa9660be", BETTER[1]))
        for run in (*runs(gains), *runs([0, 0], "omnigs"))
    ]
    found = evidence([*against(*WORSE), *others], source=OURS)
    assert (
        found.verdict == UNDECIDED and list(found.tested["scene"]) == ["basement", "plaza"] and len(found.scenes) == 5
    )
    assert (found.tested["advantage"] > 0).all() and evidence([*against(*WORSE), *others[:1]]).verdict == NOT_REPRODUCED
    assert len(evidence([*against(*WORSE), *others], source="Table 1").tested) == 5, "nothing of theirs was tuned"


def test_all_claims_share_the_level_by_the_method_of_holm():
    made = against([1, 1], [1.2, 1.2], [1.4, 1.4])  # p = 0.009
    one, others = claim(), [claim(others=["odgs"]), claim(metric="paper/ssim"), claim(metric="paper/lpips_vgg_01")]
    alone, *rest = judge([one, *others, *[one] * 3], run_set(made))
    (single,) = judge([one], run_set(made))
    assert single.verdict == HOLDS and alone.p == pytest.approx(6 * single.p) and alone.verdict == UNDECIDED
    assert math.isnan(rest[0].p), "a claim that was not measured costs nothing"
    ours, *theirs = judge([replace(one, source=OURS), *[one] * 5], run_set(made))
    assert ours.p == pytest.approx(single.p) and theirs[0].p == pytest.approx(5 * single.p), "apart from the paper's"


def test_a_claim_does_not_hold_where_runs_of_its_method_failed():
    made = against([1, 1.1, 1], [2, 2.1, 2], [1.5, 1.4, 1.5], seeds=3)
    assert verdict(made) == HOLDS
    for lost in (1, 2):  # beside runs that go on, and a length that no run reached
        failed = [
            replace(run, status="nan", scores={})
            for run in against([0] * lost, iterations=1500 if lost == 1 else 9000)
            if run.preset == "padgs"
        ]
        kept = [run for run in made if run.run not in {one.run for one in failed}]
        found = evidence([*kept, *failed])
        assert found.verdict == UNDECIDED and list(found.scenes["failed"]) == ["", "", "nan"]
        of_rivals = [replace(run, preset="omnigs", run=f"{run.run}o") for run in failed]
        assert verdict([*made, *of_rivals]) == HOLDS, "failures of rivals do not make it wrong"


def test_a_scene_where_all_runs_of_its_method_failed_is_listed():
    lost = against([0, 0], seeds=2, dataset="", fingerprint="z")
    lost = [replace(one, scene="z", status="oom" if one.preset == "padgs" else "ok", run=f"z{one.run}") for one in lost]
    lost = [replace(one, scores={}) if one.status == "oom" else one for one in lost]
    made = [*against(*BETTER), *lost]
    found = evidence(made)
    assert (found.verdict, len(found.tested), list(found.scenes["failed"])) == (UNDECIDED, 3, ["oom", "", "", ""])
    assert "nan" not in str(findings(run_set(made)).text).lower()


def test_a_scene_counts_once_whatever_the_rules_and_the_positions():
    def cropped(one):
        paper = replace(one.scores["paper"], protocol=one.scores["paper"].protocol | {"bottom_crop": 0.1})
        return replace(one, scores=one.scores | {"paper": paper}, run=f"{one.run}-cropped", iterations=3000)

    made = against(*BETTER)
    assert len(evidence([*made, *map(cropped, made)]).tested) == 3
    path = [replace(one, scene=f"{one.scene}-other-path", run=f"{one.run}-path") for one in made]
    assert len(evidence([*made, *path]).tested) == 3


@pytest.mark.parametrize(("protocol", "number"), [("paper", "paper/psnr"), ("sphere", "sphere/ws_psnr")])
def test_sides_under_different_rules_are_not_compared(protocol, number):
    made = against(*BETTER)
    for one in made:
        if one.preset == "padgs":
            one.scores[protocol] = replace(
                one.scores[protocol], protocol=one.scores[protocol].protocol | {"bottom_crop": 0.25}
            )
    with pytest.raises(Mixture, match=f"differ in {protocol} rules"):
        evidence(made, metric=number)


def test_the_best_rival_counts_and_a_required_one_must_be_there():
    both = evidence(
        [*against(BETTER[0]), *runs([0.5] * 2, "spags"), *runs([9, 9], "odgs"), *runs([9, 9], "spags_sorted")]
    )
    assert set(both.scenes["rival"]) == {title("spags")} and both.scenes["advantage"][0] == pytest.approx(0.55)
    assert not len(evidence(against(BETTER[0]), required=("spags",)).tested)
    assert len(evidence([*against(BETTER[0]), *runs([-9] * 2, "spags")], required=("spags",)).tested)


def test_claims_of_the_paper_are_judged_against_its_own_methods():
    for one in load():
        (_, others) = one.sides
        if one.source.startswith("Table") or one.source.startswith("Sec"):
            assert {*others.presets} <= {"egonerf", "op43dgs", "odgs", "omnigs", "spags", "padgs", "padgs_unmodulated"}
    assert any("spags_sorted" in one.sides[1].presets for one in load() if one.source == OURS)
    assert len(load()) == 12


def test_only_comparable_runs_count():
    made, long = against(*BETTER), against(*WORSE, iterations=7000)
    assert verdict([*made, *long]) == NOT_REPRODUCED, "the longest"
    assert verdict([*made, *(run for run in long if run.seed == 0)]) == HOLDS, "the longest with two seeds"
    failed = [replace(run, status="oom", scores={}) if run.preset == "padgs" else run for run in long]
    assert list(evidence([*made, *failed]).tested["length"].unique()) == ["1500 iterations"], "only one side reached it"
    assert verdict([*made, *against(*WORSE, width=256, height=128, iterations=9000)]) == HOLDS, "the widest"
    assert verdict([*made, *(of_experiment("length", 9, seed=seed, iterations=9000) for seed in range(3))]) == HOLDS


def test_lower_is_better_where_the_metric_says_so():
    assert verdict(against(*BETTER), metric="paper/lpips_vgg_01") == HOLDS, "made-up LPIPS falls with PSNR"


def test_costs_are_compared_by_their_ratio():
    timed = [
        of_experiment("order", 25, preset=preset, seed=seed, timing={"cpu_seconds": seconds})
        for preset, times in (("padgs", (30, 32)), ("omnigs", (60, 64)))
        for seed, seconds in enumerate(times)
    ]
    assert math.exp(evidence(timed, metric="cpu_seconds").scenes["advantage"][0]) == pytest.approx(2)


def on_machines(*machines, seconds=None, **psnr):
    """Runs of each preset with this PSNR, 0.1 dB more for each later seed: two seeds on each of its machines."""
    budget = {"budget": {"seconds": seconds, "clock": "wall"}} if seconds else {}
    made = [
        of_experiment("equal_time", value + 0.1 * seed, preset=preset, seed=seed, machine={"gpu": machine})
        for machine in machines
        for preset, value in psnr.items()
        for seed in range(2)
    ]
    return [replace(one, run=one.run + one.machine["gpu"], config=one.config | budget) for one in made]


def test_sides_after_equal_time_are_of_one_machine():
    apart = [*on_machines("slow", seconds=60.0, omnigs=25), *on_machines("fast", seconds=60.0, padgs=30)]
    assert verdict(apart, report="equal_time") == UNMEASURED, "what a minute gives depends on the machine"
    both = [*apart, *on_machines("fast", seconds=60.0, omnigs=31)]
    assert evidence(both, report="equal_time").scenes["advantage"].to_list() == pytest.approx([-1])
    counted = [*on_machines("slow", omnigs=25), *on_machines("fast", padgs=30)]
    assert evidence(counted, report="equal_time").scenes["advantage"].to_list() == pytest.approx([5]), "of iterations"


def test_sides_are_told_apart_by_keys():
    made = [run for tau, gain in ((0.9, -3.0), (0.0, 0.0)) for run in runs([gain, gain], "padgs", options={"tau": tau})]
    modulated, plain = ({"presets": ["padgs"], "keys": {"method.tau": tau}} for tau in (0.9, 0.0))
    for others in (plain, ["padgs"]):  # its own runs are no rivals
        assert evidence(made, ours=modulated, others=others).scenes["advantage"].to_list() == pytest.approx([-3])


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


def test_the_page_has_the_answer_first_then_claims_then_scenes():
    made = [replace(run, experiments=("equal_time",)) for run in against(*WORSE)]
    made += [replace(run, experiments=("equal_time",)) for scene in SCENES for run in runs([-9, -9], "spags", scene)]
    claims = {str(number): one.text for number, one in enumerate(load(), 1)}
    for of in (run_set([]), run_set(made)):
        tables = [
            [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("| ")][2:]
            for part in findings(of).text.split("\n## ")[:2]
        ]
        assert {number: text for number, text, *_ in tables[0]} == claims
        assert [number for number, *_ in tables[1]] == [*claims]
    failed = replace(made[0], run="failed", seed=9, status="nan", scores={})
    assert ", failed: nan)" in findings(run_set([*made, failed])).text
    answer, rest = findings(run_set(made)).text.split("## Evidence")
    assert f"| 10 | {claims['10']} | {OURS} | {FAILS} | 0 of 3 |" in answer
    assert "| 10 | PSNR | -1.52 | -2.77 to -0.27 | 0.035 | – |" in rest
    shown = "| 10 | 512x256, 1500 iterations | synthetic-cave -2.05 (OmniGS, corrected, 2/2); synthetic-den -1.45"
    assert shown in rest.split("## Scenes")[1]
