from dataclasses import replace

import numpy as np
import pytest
from support.made_up import assert_apart, compared, run_set, small, write

from padgs.reports import store
from padgs.reports.charts import time_chart
from padgs.reports.charts.trade_off import trade_offs
from padgs.reports.charts.trade_off_chart import LARGEST, charts, draw
from padgs.reports.frame import frame
from padgs.reports.methods import short
from padgs.reports.selection import RunSet


def one(runs):
    (made,) = trade_offs(run_set(runs))
    return made


def crowd(count: int):
    """Return runs of methods with similar numbers, the first far below and slow."""
    presets = ["egonerf_small", "padgs", "padgs_release", "padgs_ray", "odgs", "odgs_release", "spags", "spags_sorted"]
    presets += [f"method{n}" for n in range(count - len(presets))]
    return [
        small(28 + 0.2 * n + (n % 3) - 12 * (n == 0), 1 + 0.1 * (n * 7 % count) + 300 * (n == 0), method=preset)
        for n, preset in enumerate(presets[:count])
    ]


@pytest.mark.parametrize("count", [1, 2, 20])
def test_all_methods_have_labels_that_do_not_touch(count):
    for panel, texts in draw(one(crowd(count)))[1]:
        named = {short(mark.point.title, mark.point.preset) for mark in panel.marks if mark.role != "release"}
        assert {text.get_text().split("\n")[0] for text in texts} == named
        assert_apart(panel, texts)


def test_an_outlier_stands_in_the_margin_with_its_numbers():
    for panel, texts in draw(one(crowd(12)))[1]:
        low, high = panel.axes.get_ylim()
        assert high - low < 8 and panel.axes.get_xlim()[1] < 1000
        stray = next(mark for mark in panel.marks if mark.point.preset == "egonerf_small")
        others = [mark for mark in panel.marks if mark is not stray]
        assert low < stray.at[1] < min(mark.y for mark in others) and stray.at[0] > max(mark.x for mark in others)
        assert stray.sides == (1, -1) and all(mark.sides == (0, 0) for mark in others)
        words = next(text.get_text() for text in texts if "EgoNeRF" in text.get_text())
        assert "15.6 dB" in words and words.endswith("s")
        assert max(found.get_sizes()[0] for found in scatters(panel)) == LARGEST, "its Gaussians scale no area"


def test_releases_are_small_rings_without_labels_and_not_in_the_front():
    runs = [small(25.0, 2.0, method="odgs"), small(30.0, 0.5, method="odgs_release"), small(24.0, 1.0, method="padgs")]
    _, ((panel, texts), _) = draw(one(runs))
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
    _, ((panel, _), _) = draw(one(runs))
    small_one, large_one = (found.get_sizes()[0] for found in scatters(panel))
    assert large_one / small_one == pytest.approx(3)
    heights = [top - bottom for line in panel.lines for (x, bottom), (right, top) in [line[:2]] if x == right]
    assert heights.count(pytest.approx(np.sqrt(2))) == 2


def test_a_mark_has_a_tooltip_with_its_numbers():
    (made,) = charts(run_set(compared(["synthetic-room"])))
    assert "<title>PaD-GS\nWS-PSNR: 25.65\n" in made.svg and ">PaD-GS<" in made.svg
    assert ">time per frame, ms ↓<" in made.svg and made.png.startswith(b"\x89PNG")


def test_quality_over_training_time_comes_from_the_logs(tmp_path):
    runs = compared(["synthetic-room"], seeds=2)
    runs.append(replace(small(20.0, method="mine", experiments=("all_methods",)), status="oom"))
    (logged,) = trade_offs(RunSet(frame(store.read(write(runs, tmp_path))[0])))
    chart = time_chart.chart(logged)
    assert chart.name == "time_synthetic-room" and ">PaD-GS<" in chart.svg and ">mine<" in chart.svg
    assert "<title>PaD-GS\n25.52 dB after 200 s</title>" in chart.svg  # 26.05 of two seeds - 8 / 15 at the last probe
    assert time_chart.chart(one(runs)) is None, "no quality over time without a log"
