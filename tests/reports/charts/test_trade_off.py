import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.made_up import METHODS, assert_apart, at_equal_time, compared, data_set, run_set, small, write

from padgs import results
from padgs.reports import store
from padgs.reports.charts import trade_off_chart
from padgs.reports.charts.trade_off import equal_times, pareto, trade_offs
from padgs.reports.charts.trade_off_chart import NAMED, chart, charts, draw, equal_time_charts, time_chart
from padgs.reports.frame import frame
from padgs.reports.methods import short
from padgs.reports.selection import RunSet
from padgs.reports.table import ReportError


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
def test_all_methods_within_the_axes_have_labels_that_do_not_touch(count):
    for panel, marks, _, texts in draw(one(crowd(count)))[1]:
        shown = {
            short(mark.point.title, mark.point.preset) for mark in marks if count < 3 or "ego" not in mark.point.preset
        }
        assert {text.get_text() for text in texts} == shown
        assert_apart(panel, texts)


def test_axes_show_where_methods_differ_and_a_note_names_those_beyond():
    made = one(crowd(12))
    for panel, marks, _, texts in draw(made)[1]:
        low, high = panel.get_ylim()
        assert high - low < 8 and panel.get_xlim()[1] < 1000
        assert [mark.point.preset for mark in marks if not low < mark.y < high] == ["egonerf_small"]
        assert not any("EgoNeRF" in text.get_text() for text in texts)
    assert "Beyond the axes: EgoNeRF, small (15.6 dB, " in "".join(chart(made).notes)
    (legend,) = draw(made)[0].legends
    assert "Beyond the axes: EgoNeRF, small (15.6 dB, " in legend.get_title().get_text(), "of a picture read alone"


def test_releases_are_small_rings_and_not_in_the_front():
    runs = [small(25.0, 2.0, method="odgs"), small(30.0, 0.5, method="odgs_release"), small(24.0, 1.0, method="padgs")]
    _, ((panel, marks, _, _), _) = draw(one(runs))
    looks = {m.point.preset: c for m, c in zip(marks, scatters(panel), strict=True)}
    ring, full = looks["odgs_release"], looks["odgs"]
    assert len(ring.get_facecolor()) == 0 and ring.get_alpha() < full.get_alpha()
    assert ring.get_sizes()[0] < full.get_sizes()[0]
    front = panel.lines[0].get_xydata()
    assert front.tolist()[0] == [100, 23.6] and front[-1, 1] == 24.6, "the release is better and cheaper"


def scatters(panel):
    from matplotlib.collections import PathCollection

    return [found for found in panel.collections if isinstance(found, PathCollection)]


def test_bars_are_the_spread_of_seeds():
    runs = [
        small(25 + seed, cost, method=m, seed=seed) for m, cost in (("odgs", 1.0), ("spags", 3.0)) for seed in (0, 1)
    ]
    _, ((panel, *_), _) = draw(one(runs))
    bars = [
        segment for lines in panel.collections if hasattr(lines, "get_segments") for segment in lines.get_segments()
    ]
    heights = [abs(end[1] - start[1]) for start, end in bars]
    assert heights.count(pytest.approx(np.sqrt(2))) == 2


def test_a_chart_names_its_marks_and_axes():
    (made,) = charts(run_set(compared(["synthetic-room"])))
    assert ">PaD-GS<" in made.svg
    assert ">time per frame, ms, log scale ↓<" in made.svg and made.png.startswith(b"\x89PNG")


def test_after_equal_time_only_the_time_per_frame_is_a_cost():
    runs = at_equal_time("synthetic-room")
    (made,) = equal_time_charts(run_set(runs))
    assert made.name == "equal_time_synthetic-room_512x256_60-s-of-CPU-time" and len(made.figure.axes) == 1
    assert ">time per frame, ms, log scale ↓<" in made.svg and equal_time_charts(run_set(runs[:2])) == []


def test_the_mean_over_scenes_after_equal_time_comes_first():
    runs = at_equal_time("synthetic-room", "synthetic-outdoor")
    mean, *scenes = equal_times(run_set(runs))
    assert mean.name == "equal_time_mean_tuned-on_512x256_60-s-of-CPU-time" and len(scenes) == 2
    assert mean.title == "mean over synthetic-outdoor, synthetic-room (tuned on), 512x256, 60 s of CPU time"
    assert numbers(mean)["OmniGS, corrected", "WS-PSNR"] == pytest.approx((26 + 30) / 2 - 0.4)
    assert [made.name for made in equal_times(run_set(runs[:5]))] == [scenes[1].name], "two methods are no chart"
    (panel, marks, _, _), *_ = draw(mean)[1]
    slow = min(marks, key=lambda mark: mark.y)
    assert slow.point.preset == "odgs" and slow.x == panel.lines[0].get_xydata()[0, 0], "it begins the front"
    other = replace(runs[0], config={**runs[0].config, "method": {"tau": 0.5}})
    differing = run_set([other, *runs[1:]])
    assert len(equal_times(differing)) == 2 and "so there is no mean" in "".join(differing.warnings)


def test_quality_over_training_time_comes_from_the_logs(tmp_path, monkeypatch):
    named = []
    monkeypatch.setattr(trade_off_chart, "write_labels", lambda _, labels, __: named.append(labels))
    runs = compared(["synthetic-room"], seeds=2)
    runs.append(replace(small(20.0, method="mine", experiments=("all_methods",)), status="oom"))
    (logged,) = trade_offs(RunSet(frame(store.read(write(runs, tmp_path))[0])))
    made = time_chart(logged)
    assert made.name == "time_synthetic-room" and "PaD-GS" in {label.text for label in named[0]}
    assert len(logged.points) > NAMED == len(named[0])
    assert (200, pytest.approx(25.52, abs=0.01)) in [label.at for label in named[0]]  # 26.05 - 8 / 15 at the last probe
    assert time_chart(one(runs)) is None, "no quality over time without a log"


def test_a_curve_is_a_mean_over_scenes_and_of_finished_runs(tmp_path):
    def many(method, scene, psnr, seeds):
        own = {"method": method, "dataset": "roam360", "scene": scene, "fingerprint": scene}
        return [small(psnr, seed=seed, run=f"{scene}{method}{seed}", **own) for seed in range(seeds)]

    made = [*many("padgs", "bar", 30, 3), *many("padgs", "base", 20, 3)]
    made += [*many("omnigs", "bar", 30, 3), *many("omnigs", "base", 20, 1)]
    made.append(replace(many("spags", "bar", 34, 1)[0], status="degenerate"))
    (logged,) = trade_offs(RunSet(frame(store.read(write(made, tmp_path))[0])))
    ends = {setting.preset: psnr[-1] for setting, _, psnr in trade_off_chart._curves(logged)}
    assert ends == pytest.approx(dict.fromkeys(("omnigs", "padgs"), 25 - 8 / 15))
    assert logged.notes[-1] == "Failed runs are left out: SPaGS (DEGENERATE)."


def test_seeds_of_a_time_are_averaged_however_many_iterations_they_made(tmp_path):
    made = [small(20.0 + 4 * seed, seed=seed, run=f"seed{seed}", iterations_done=1500) for seed in range(3)]
    write(made, tmp_path)
    log = tmp_path / "seed2" / "log.jsonl"  # twice as fast, and twice as many iterations
    results.write(replace(made[2], iterations_done=3000), tmp_path / "seed2")
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    fast = [{**one, "iteration": n} for one in lines for n in (2 * one["iteration"] - 100, 2 * one["iteration"])]
    log.write_text("".join(json.dumps(line) + "\n" for line in fast))
    (logged,) = trade_offs(RunSet(frame(store.read(tmp_path)[0])))
    ((_, seconds, psnr),) = trade_off_chart._curves(logged)
    assert psnr[-1] == pytest.approx(24 - 8 / 15) and seconds[-1] == pytest.approx(100)
    log.write_text("".join(json.dumps(line) + "\n" for line in fast[:-1]))
    (cut,) = trade_offs(RunSet(frame(store.read(tmp_path)[0])))
    assert trade_off_chart._curves(cut)[0][2][-1] == pytest.approx(22 - 8 / 15)
    assert time_chart(cut).notes[-1] == "Without a complete log, so in no line: seed2."


def test_a_legend_counts_the_seeds_of_its_bars():
    runs = [small(25.0 + seed, seed=seed, run=f"a{seed}") for seed in range(3)]
    runs += [small(24.0 + seed, method="omnigs", seed=seed, run=f"b{seed}") for seed in range(2)]
    assert "deviation over 2 to 3 seeds" in trade_off_chart._conditions(one(runs))
    single = [small(25.0), small(24.0, method="omnigs", seed=1)]
    assert "deviation" not in trade_off_chart._conditions(one(single))


def test_time_is_cpu_time_where_that_is_known(tmp_path, monkeypatch):
    ends = []
    monkeypatch.setattr(trade_off_chart, "write_labels", lambda _, __, marks: ends.extend(x for x, *_ in marks))
    timing = {"train_seconds": 100.0, "cpu_seconds": 40.0, "render_ms_median": 40.0}
    (logged,) = trade_offs(RunSet(frame(store.read(write([small(25.0, timing=timing)], tmp_path))[0])))
    (panel,) = time_chart(logged).figure.axes
    assert ends[0] == pytest.approx(40.0) == max(ends) and panel.get_xlabel().startswith("training time on the CPU")


def test_each_method_has_one_name_over_time_at_its_best_setting_within_the_axis():
    made = one([small(20 + n, 1.0, method=preset) for n, preset in enumerate(["padgs", "odgs", "spags", "omnigs"])])
    ends = [
        ("padgs", 20),
        ("padgs", 21),
        ("odgs", 25),
        ("odgs", 24),
        ("spags", 30),
        ("spags", 99),
        ("padgs_release", 28),
    ]
    curves = [(SimpleNamespace(preset=preset, title=f"{preset} {end}"), [1.0], [end]) for preset, end in ends]
    named = trade_off_chart._named(made, curves, 10, 50)
    assert [*named.items()] == [("padgs", "padgs 21"), ("spags", "spags 30"), ("odgs", "odgs 25")]


def numbers(chart) -> dict[tuple[str, str], float]:
    return chart.numbers.set_index(["setting", "quantity"])["mean"].to_dict()


def failed(runs, fails):
    return [replace(run, status="oom", scores={}) if fails(run) else run for run in runs]


def test_a_point_for_each_setting_that_finished():
    config = {"train": {"iterations": 3000}, "method": {"tau": 0.9}}
    longer = [small(28.0, 3.0, experiments=("pareto@cpu",), iterations=3000, config=config)]
    charts = {chart.name: chart for chart in trade_offs(run_set([*compared(), *longer]))}
    found = numbers(charts["chart_synthetic-room"])
    assert found["ODGS, corrected", "WS-PSNR"] == pytest.approx(22 + 1.6 + 0.05 - 0.4)
    assert found["ODGS, corrected", "ms per frame"] == pytest.approx(40 * 1.1)
    ours = {title for title, _ in found if title.startswith("PaD-GS")}
    assert ours == {"PaD-GS, iterations 1500", "PaD-GS, iterations 3000"}
    assert {point.preset for point in charts["chart_synthetic-outdoor"].points} == set(METHODS) - {"op43dgs"}


def test_a_data_set_is_averaged_over_the_scenes_that_all_settings_finished():
    (chart,) = trade_offs(run_set(failed(data_set("roam360"), lambda r: (r.scene, r.method) == ("bar", "padgs"))))
    assert "mean over its scenes base, cafe" in chart.title
    assert numbers(chart)["OmniGS, corrected", "PSNR"] == pytest.approx(20 + 5.5)  # scenes 1..10
    (chart,) = trade_offs(run_set(failed(data_set("roam360"), lambda r: r.method == "padgs")))
    assert "scenes bar, base" in chart.title and [point.preset for point in chart.points] == ["omnigs"]
    assert chart.notes[-1] == "Failed runs are left out: PaD-GS (OOM)."


@pytest.mark.parametrize(
    "change", [{"status": "oom", "scores": {}}, {"config": {"train": {"iterations": 30_000}, "method": {"tau": 0.0}}}]
)
def test_without_a_scene_that_all_settings_finished_there_is_a_warning_and_no_chart(change):
    changed = (("padgs", True), ("omnigs", False))  # method, whether on the scene bar
    runs = [replace(r, **change) if (r.method, r.scene == "bar") in changed else r for r in data_set("roam360")]
    of = run_set(runs)
    assert trade_offs(of) == [] and "chart_roam360: no scene was finished in all settings" in "".join(of.warnings)


def test_no_point_of_the_front_is_beaten():
    points = [(1.0, 20.0), (1.0, 21.0), (2.0, 20.5), (3.0, 24.0), (4.0, 24.0)]
    assert pareto(points) == [(1.0, 21.0), (3.0, 24.0)]


def test_lengths_machines_and_settings_of_the_shown_protocol_are_not_mixed():
    runs = [replace(r, iterations=7000) if r.scene == "bar" else r for r in data_set("roam360")]
    with pytest.raises(ReportError, match="roam360, OmniGS, corrected: results differ in length"):
        trade_offs(run_set(runs))
    first, *others = compared()
    with pytest.raises(ReportError, match="differ in machine"):
        trade_offs(run_set([replace(first, machine={"gpu": "H200"}), *others]))
    sphere = replace(first.scores["sphere"], protocol=first.scores["sphere"].protocol | {"bottom_crop": 0.1})
    with pytest.raises(ReportError, match="differ in sphere rules"):
        trade_offs(run_set([replace(first, scores=first.scores | {"sphere": sphere}), *others]))


def test_of_two_runs_with_one_setting_and_seed_neither_is_chosen():
    first, *others = compared()
    with pytest.raises(ReportError, match="again are the same setting; delete one of them"):
        trade_offs(run_set([first, *others, replace(first, run="again", scores=small(9.0).scores)]))


def test_scenes_of_two_data_sets_may_have_one_name():
    charts = trade_offs(run_set([small(25.0, scene="room"), small(26.0, scene="room", dataset="")]))
    assert [chart.name for chart in charts] == ["chart_room", "chart_room_synthetic"]


def test_roles_of_presets_and_corrected_methods_of_releases():
    presets = ("odgs", "odgs_release", "egonerf_small", "padgs", "padgs_ray", "padgs_plus", "spags_release", "mine")
    (chart,) = trade_offs(run_set([small(25.0 + i, 1 + i, method=name) for i, name in enumerate(presets)]))
    roles = {preset: chart.role(preset) for preset in presets}
    assert {preset for preset, role in roles.items() if role == "release"} == {"odgs_release", "spags_release"}
    assert {preset for preset, role in roles.items() if role == "variant"} == {"padgs_ray"}
