from dataclasses import replace

import numpy as np
import pytest
from made_up import assert_apart, compared, gathered, small, write

from padgs.reports import store
from padgs.reports.charts import time_chart
from padgs.reports.charts.trade_off import trade_offs
from padgs.reports.charts.trade_off_chart import LARGEST, NARROW, WIDE, charts, drawn
from padgs.reports.frame import frame
from padgs.reports.gathered import Gathered
from padgs.reports.methods import short


def one(runs):
    (made,) = trade_offs(gathered(runs))
    return made


def crowd(count: int):
    """Methods at the corner of a spiral, the first far below and slow."""
    presets = ["egonerf_small", "padgs", "padgs_release", "padgs_ray", "odgs", "odgs_release", "spags", "spags_sorted"]
    presets += [f"method{n}" for n in range(count - len(presets))]
    return [
        small(28 + 0.2 * n + (n % 3) - 12 * (n == 0), 1 + 0.1 * (n * 7 % count) + 300 * (n == 0), method=preset)
        for n, preset in enumerate(presets[:count])
    ]


@pytest.mark.parametrize("count", [1, 2, 20])
def test_one_method_is_drawn_and_twenty_have_names_that_do_not_touch(count):
    made, _, panels = drawn(one(crowd(count)), NARROW)
    for panel, texts in panels:
        named = {short(mark.point.title, mark.point.preset) for mark in panel.marks if mark.role != "release"}
        assert {text.get_text().split("\n")[0] for text in texts} == named
        assert_apart(panel, texts)


def test_a_method_far_below_stands_at_the_margin_with_its_numbers():
    _, _, (first, second) = drawn(one(crowd(12)), WIDE)
    for panel, texts in (first, second):
        low, high = panel.axes.get_ylim()
        assert high - low < 8 and panel.axes.get_xlim()[1] < 1000
        stray = next(mark for mark in panel.marks if mark.point.preset == "egonerf_small")
        others = [mark for mark in panel.marks if mark is not stray]
        assert low < stray.at[1] < min(mark.y for mark in others) and stray.at[0] > max(mark.x for mark in others)
        assert stray.sides == (1, -1) and all(mark.sides == (0, 0) for mark in others)
        words = next(text.get_text() for text in texts if "EgoNeRF" in text.get_text())
        assert "15.6 dB" in words and words.endswith("s")
        assert max(found.get_sizes()[0] for found in scatters(panel)) == LARGEST[WIDE], "its Gaussians scale no area"


def test_released_programs_are_small_rings_without_names_that_count_for_nothing():
    runs = [small(25.0, 2.0, method="odgs"), small(30.0, 0.5, method="odgs_release"), small(24.0, 1.0, method="padgs")]
    _, _, ((panel, texts), _) = drawn(one(runs), WIDE)
    assert [text.get_text() for text in texts] == ["ODGS", "PaD-GS"]
    looks = {m.point.preset: c for m, c in zip(panel.marks, scatters(panel), strict=True)}
    ring, full = looks["odgs_release"], looks["odgs"]
    assert len(ring.get_facecolor()) == 0 and ring.get_alpha() < full.get_alpha()
    assert ring.get_sizes()[0] < full.get_sizes()[0]
    front, link = (np.array(line) for line in panel.lines[:2])
    assert front.tolist()[0] == [100, 23.6] and front[-1, 1] == 24.6, "the release is better and cheaper"
    assert sorted(link.tolist()) == [[50, 29.6], [200, 24.6]]


def scatters(panel):
    from matplotlib.collections import PathCollection

    return [found for found in panel.axes.collections if isinstance(found, PathCollection)]


def test_the_area_is_the_number_of_gaussians_and_bars_are_the_spread():
    runs = [
        small(25 + seed, cost, method=m, seed=seed) for m, cost in (("odgs", 1.0), ("spags", 3.0)) for seed in (0, 1)
    ]
    _, _, ((panel, _), _) = drawn(one(runs), WIDE)
    small_one, large_one = (found.get_sizes()[0] for found in scatters(panel))
    assert large_one / small_one == pytest.approx(3)
    heights = [top - bottom for line in panel.lines for (x, bottom), (right, top) in [line[:2]] if x == right]
    assert heights.count(pytest.approx(np.sqrt(2))) == 2


def test_a_mark_says_its_numbers_and_a_phone_has_a_picture_of_its_own():
    (made,) = charts(gathered(compared(["synthetic-room"])))
    for svg in (made.svg, made.narrow):
        assert "<title>PaD-GS\nWS-PSNR: 25.65\n" in svg and ">PaD-GS<" in svg and ">time per frame, ms ↓<" in svg
    widths = [float(svg.split('width="', 1)[1].split("pt", 1)[0]) for svg in (made.svg, made.narrow)]
    assert widths[0] > 2 * widths[1] and made.png.startswith(b"\x89PNG")


def test_quality_over_training_time_comes_from_the_logs(tmp_path):
    runs = compared(["synthetic-room"], seeds=2)
    runs.append(replace(small(20.0, method="mine", experiments=("all_methods",)), status="oom"))
    (logged,) = trade_offs(Gathered(frame(store.read(write(runs, tmp_path))[0])))
    chart = time_chart.chart(logged)
    assert chart.name == "time_synthetic-room" and ">PaD-GS<" in chart.narrow and ">mine<" in chart.svg
    assert "<title>PaD-GS\n25.52 dB after 200 s</title>" in chart.svg  # 26.05 of two seeds - 8 / 15 at the last probe
    assert time_chart.chart(one(runs)) is None, "no quality over time without a log"
