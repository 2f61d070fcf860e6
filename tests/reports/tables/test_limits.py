from dataclasses import replace

from made_up import failed, of_experiment, run_set

from padgs.data.perturb import CONDITIONS
from padgs.reports.robustness import LIMITS, LIMITS_ARE_FOR, limits
from padgs.results import Scores

RULES = {"name": "stability", "lpips": "none", "lpips_inputs": "11", "bottom_crop": 0.0}
MARKS = {"ws_psnr_one_color": 12.0, "seam": 1.0, "depth_error": 0.05}
SIZE, ITERATIONS = LIMITS_ARE_FOR
WIDTH, HEIGHT = map(int, SIZE.split("x"))


def run(preset: str, quality: float, condition: str = "", level: int = 0, seed: int = 0, **marks: float):
    made = of_experiment("stress@cpu", quality, preset=preset, seed=seed)
    marks = MARKS | {"ws_psnr": quality} | marks
    stress = {"stress": {"condition": condition, "level": level}} if condition else {}
    return replace(
        made,
        run=f"{made.run}_{condition}_{level}",
        variant=f"{condition} {level}" if condition else "",
        width=WIDTH,
        height=HEIGHT,
        iterations=ITERATIONS,
        config=made.config | stress,
        scores={"stability": Scores(RULES, marks, {"a": marks})},
    )


def cells(*runs):
    table = limits(run_set(list(runs)))
    (block,) = table.blocks
    heads = [column.title for column in table.columns]
    return {row.title: dict(zip(heads, row.texts(table.columns)[1:], strict=True)) for row in block.rows}


def test_what_is_lost_stands_beside_what_may_be():
    lost = cells(
        run("omnigs", 22.0),
        run("omnigs", 21.6, "pose_noise", 1),
        run("omnigs", 19.5, "pose_noise", 2),
        run("omnigs", 22.5, "jpeg", 1),
    )
    assert lost["pose_noise 1, dB"] == {"allowed": "0.50", "OmniGS, corrected": "0.40"}
    assert lost["pose_noise 2, dB"] == {"allowed": "2.00", "OmniGS, corrected": "2.50 [BEYOND]"}
    assert lost["jpeg 1, dB"] == {"allowed": "–", "OmniGS, corrected": "-0.50"}


def test_some_conditions_are_judged_by_another_mark():
    lost = cells(
        run("omnigs", 22.0, ws_psnr_fitted=23.0),
        run("omnigs", 12.5, "exposure", 1, ws_psnr_fitted=22.7),
        run("omnigs", 22.0, "seam", 1, seam=1.2),
        run("omnigs", 12.0, "textureless", 1, depth_error=0.09),
    )
    assert lost["exposure 1, dB after a fit of colours"]["OmniGS, corrected"] == "0.30"
    assert lost["seam 1, seam"] == {"allowed": "1.10", "OmniGS, corrected": "1.20 [BEYOND]"}
    assert lost["textureless 1, depth error"]["OmniGS, corrected"] == "0.09"
    unknown = cells(run("omnigs", 22.0), run("omnigs", 12.5, "exposure", 1))
    assert unknown["exposure 1, dB after a fit of colours"]["OmniGS, corrected"] == "–", "measured before there was one"


def test_seeds_are_compared_with_their_own_and_failures_are_told():
    first, second = run("omnigs", 22.0), run("omnigs", 24.0, seed=1)
    spoilt = [
        run("omnigs", 21.0, "seam", 1),
        run("omnigs", 21.0, "pose_noise", 1),
        run("omnigs", 23.8, "pose_noise", 1, 1),
    ]
    diverged = replace(spoilt[0], status="diverged", scores={})
    lost = cells(first, second, diverged, *spoilt[1:])
    assert lost["pose_noise 1, dB"]["OmniGS, corrected"] == "0.60 ± 0.57 [BEYOND]"
    assert lost["seam 1, seam"]["OmniGS, corrected"] == "DIVERGED"


def test_runs_of_other_sizes_and_lengths_have_no_limits():
    rest, noisy = run("omnigs", 22.0), run("omnigs", 21.6, "pose_noise", 1)
    for other in ({"width": 128, "height": 64}, {"iterations": 250}):
        assert limits(run_set([replace(rest, **other), replace(noisy, **other)])).blocks == ()
    assert limits(run_set([failed("", "oom")])).blocks == ()


def test_limits_are_of_known_conditions_and_their_levels():
    for name, limit in LIMITS.items():
        allowed = limit.get("allowed", [])
        assert len(allowed) <= len(CONDITIONS[name].levels) and allowed == sorted(allowed)
