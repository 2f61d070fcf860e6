from dataclasses import replace

import pytest
from support.made_up import METHODS, compared, data_set, run_set, small

from padgs.reports.charts.trade_off import pareto, trade_offs
from padgs.reports.table import ReportError


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
    with pytest.raises(ReportError, match="differ in protocol"):
        trade_offs(run_set([replace(first, scores=first.scores | {"sphere": sphere}), *others]))


def test_scenes_of_two_data_sets_may_have_one_name():
    charts = trade_offs(run_set([small(25.0, scene="room"), small(26.0, scene="room", dataset="")]))
    assert [chart.name for chart in charts] == ["chart_room", "chart_room_synthetic"]


def test_roles_of_presets_and_corrected_methods_of_releases():
    presets = ("odgs", "odgs_release", "egonerf_small", "padgs", "padgs_ray", "padgs_plus", "spags_release", "mine")
    (chart,) = trade_offs(run_set([small(25.0 + i, 1 + i, method=name) for i, name in enumerate(presets)]))
    roles = {preset: chart.role(preset) for preset in presets}
    assert {preset for preset, role in roles.items() if role == "release"} == {"odgs_release", "spags_release"}
    assert {preset for preset, role in roles.items() if role == "variant"} == {"padgs_ray"}
