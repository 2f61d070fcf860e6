"""Which models are asked for, and which is the smallest that is good enough, on losses that are made up."""

import math
from dataclasses import asdict
from statistics import mean

import pytest

from padgs.need.calibration import calibration_split, lower_bound, objections
from padgs.need.plan import Plan, Step, knee, loss, plan, smallest
from padgs.results import NEED_LOSSES, Scores

BANDS = ("equator", "middle", "high", "pole", "zenith", "nadir")


def marks(*views: float, lpips: float = 0.1, **bands: float) -> Scores:
    """Of views with these WS-PSNRs; bands as they are, unless they say otherwise."""
    each: dict[str, dict[str, float | None]] = {
        str(number): {"ws_psnr": value, "ws_lpips_alex": lpips}
        | {f"ws_psnr_{band}": value + bands.get(band, 0.0) for band in BANDS}
        for number, value in enumerate(views)
    }
    return Scores({}, {"ws_psnr": mean(views), "ws_lpips_alex": lpips}, each)


def searched(quality, rows: int = 10_000) -> list[Step]:
    """All steps of a search in which a model of N rows, refined d times, shows `quality(N, d)` dB."""
    steps: list[Step] = []
    while (wanted := plan(steps)) is not None:
        parent = None if wanted.parent is None else steps[wanted.parent]
        count = wanted.rows or (rows if parent is None else parent.rows)
        depth = 0 if parent is None else parent.depth + 1
        value = quality(count, depth)
        steps.append(Step(wanted.kind, wanted.parent, depth, count, count, count, 1.0, marks(value, value, value)))
        assert len(steps) < 60, "a search ends"
    return steps


def test_the_first_step_leaves_out_waste_and_every_other_one_has_a_control():
    assert plan([]) == Plan("waste", None)
    first = Step("waste", None, 0, 1000, 1000, 0, 1.0, marks(30, 30, 30))
    assert plan([first]) == Plan("control", 0)
    second = Step("control", 0, 1, 1000, 1000, 0, 1.0, marks(29, 29, 29))
    assert plan([first, second]) == Plan("prune", 0, 700)
    third = Step("prune", 0, 1, 700, 700, 0, 1.0, marks(28.9, 28.9, 28.9))
    assert loss([first, second, third], 2) == pytest.approx(0.1), "what both forgot is no loss"


def test_the_need_for_each_loss_is_found_to_a_sixth():
    def lost(rows: int) -> float:
        return 0.3 * max(0.0, math.log2(5000 / rows)) ** 1.5

    steps = searched(lambda rows, depth: 33 - 0.2 * depth - lost(rows))
    for epsilon in NEED_LOSSES:
        true = min(rows for rows in range(100, 10_001) if lost(rows) < epsilon)
        found = steps[smallest(steps, epsilon)].rows
        assert true <= found <= 1.2 * true + 1, epsilon
    at = knee(steps)
    assert at is not None and 3500 < steps[at].rows < 7500


def test_a_model_that_needs_nothing_ends_at_a_few_rows_and_one_that_needs_all_keeps_them():
    assert 10 <= searched(lambda rows, depth: 30.0)[-1].rows < 15
    steps = searched(lambda rows, depth: 30.0 - 100 * (rows < 10_000))
    assert all(steps[smallest(steps, epsilon)].rows == 10_000 for epsilon in NEED_LOSSES)
    assert knee(searched(lambda rows, depth: 30.0)) is None


@pytest.mark.parametrize(
    ("candidate", "why"),
    [
        (marks(30.0, 30.0, 30.0), ()),
        (marks(29.95, 29.95, 29.95), ()),
        (marks(29.85, 29.85, 29.85), ("WS-PSNR may fall",)),
        (marks(30.2, 30.0, 29.8), ("WS-PSNR may fall",)),
        (marks(30.0, 30.0, 30.0, pole=-0.3), ("pole falls by 0.30 dB",)),
        (marks(30.0, 30.0, 30.0, lpips=0.106), ("LPIPS rises by 0.0060",)),
        (marks(30.9, 30.9, 29.4), ("WS-PSNR may fall", "a view falls by 0.60 dB")),
    ],
)
def test_each_rule_objects_by_name(candidate, why):
    found = objections(candidate, marks(30.0, 30.0, 30.0), 0.1)
    assert len(found) == len(why) and all(text.startswith(word) for text, word in zip(found, why, strict=True)), found


def test_the_bound_is_that_of_students_t():
    # mean 0, s = 0.1, n = 3: t(0.95, 2) = 2.920; -2.920 * 0.1 / sqrt(3)
    assert lower_bound([0.1, 0.0, -0.1]) == pytest.approx(-0.16859, abs=1e-5)


def test_calibration_views_are_spread_evenly_and_too_few_are_refused():
    chosen, left = calibration_split(list(range(48)))  # type: ignore[arg-type]
    assert chosen == (4, 12, 20, 28, 36, 44) and len(left) == 42
    assert len(calibration_split(list(range(6)))[0]) == 3  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="5 training views leave no calibration views.*it takes 6"):
        calibration_split(list(range(5)))  # type: ignore[arg-type]


def test_a_step_survives_json():
    step = Step("prune", 0, 1, 700, 700, 0, 1.0, marks(28.9))
    values = asdict(step)
    values["marks"] = Scores(**values["marks"])
    assert Step(**values) == step
