from dataclasses import replace

import pytest
from support.made_up import compared, run_set, small, swept

from padgs.reports.charts.sweep_chart import chart, charts, sweeps
from padgs.reports.table import ReportError


def test_a_curve_per_scene_has_means_over_seeds_along_the_key_that_differs():
    (sweep,) = sweeps(run_set([*swept("tau"), *compared()], protocol="sphere"))
    assert (sweep.name, sweep.key) == ("tau@cpu", "method.tau")
    assert [curve.place.scene for curve in sweep.curves] == ["synthetic-outdoor", "synthetic-room"]
    assert [x for x, _ in sweep.curves[0].points] == [0.0, 0.5, 0.9, 1.0]
    at = sweep.numbers.set_index(["scene", "x", "quantity"])
    best = at.loc[("synthetic-room", 0.9, "WS-PSNR")]
    assert (best["mean"], best["std"], best["n"]) == (pytest.approx(25 + 0.1 - 0.4), pytest.approx(0.1), 3)
    assert at.loc[("synthetic-room", 1.0, "Gaussians"), "mean"] == 100_000


def test_two_keys_give_a_curve_for_each_value_of_the_second():
    grid = [
        small(25, 1 + offsets / 10 + features / 100, experiments=("grid",), config={"method": method})
        for offsets in (5, 10)
        for features in (16, 32, 64)
        if (method := {"offsets": offsets, "features": features})
    ]
    (sweep,) = sweeps(run_set(grid))
    assert sweep.key in ("method.features", "method.offsets")
    assert {len(curve.points) for curve in sweep.curves} in ({2}, {3})
    assert all(curve.fixed for curve in sweep.curves)


def test_settings_without_numeric_keys_have_names():
    projections = [
        small(25 + i, 1 + i, experiments=("projections",), config={"render": {"projection": name}})
        for i, name in enumerate(("tangent", "erp"))
    ]
    (sweep,) = sweeps(run_set(projections))
    assert sweep.key == "" and [x for x, _ in sweep.curves[0].points] == ["projection erp", "projection tangent"]
    assert "projection tangent" in chart(sweep).svg


def test_keys_that_share_an_axis_are_named_along_it():
    made = [
        small(25 + i, 1 + i, experiments=("mine",), config={"method": {"tau": t}}) for i, t in enumerate((0.0, 0.9))
    ]
    made += [
        small(25 + i, 3 + i, method="omnigs", experiments=("mine",), config={"method": {"offsets": n}})
        for i, n in enumerate((5, 10))
    ]
    (sweep,) = sweeps(run_set(made))
    drawn = chart(sweep).svg
    assert sweep.key == "" and all(f">{words}<" in drawn for words in ("tau 0.0", "tau 0.9", "offsets 5", "offsets 10"))


def test_a_failed_point_shows_its_status():
    runs = [replace(r, status="nan", scores={}) if r.config["method"]["tau"] == 1.0 else r for r in swept("tau")]
    (sweep,) = sweeps(run_set(runs, metrics=("ssim",)))
    failed = sweep.numbers.loc[sweep.numbers["x"] == 1.0]
    assert failed["mean"].isna().all() and set(failed["status"]) == {"nan"}
    assert ">NAN<" in chart(sweep).svg


def test_metrics_are_chosen_by_name_and_unknown_ones_list_the_known():
    (sweep,) = sweeps(run_set(swept("tau"), protocol="sphere", metrics=("ws_psnr", "frame_ms")))
    assert [measure.column.title for measure in sweep.measures] == ["WS-PSNR", "ms per frame"]
    with pytest.raises(ReportError, match="unknown metric 'psrn'; known under protocol paper: psnr, ssim, .*frame_ms"):
        sweeps(run_set(swept("tau"), metrics=("psrn",)))


def test_an_experiment_is_chosen_and_those_of_charts_are_sweeps_only_if_requested():
    runs = [*swept("tau", seeds=1), *swept("lambda_l1", seeds=1)]
    assert [sweep.name for sweep in sweeps(run_set(runs))] == ["lambda_l1@cpu", "tau@cpu"]
    assert [sweep.name for sweep in sweeps(run_set(runs, experiment="tau@cpu"))] == ["tau@cpu"]
    lengths = [small(25.0, 1.0 + n, experiments=("pareto",), config={"train": {"iterations": n}}) for n in (1, 2)]
    assert sweeps(run_set(lengths)) == sweeps(run_set(compared())) == []
    assert [sweep.key for sweep in sweeps(run_set(lengths, experiment="pareto"))] == ["train.iterations"]


def test_protocols_are_not_mixed_along_a_curve_nor_data_in_a_point():
    first, *others = swept("tau")
    other = replace(first, scores={"paper": replace(first.scores["paper"], protocol={"lpips": "alex"})})
    with pytest.raises(ReportError, match="tau@cpu, .*differ in paper rules"):
        sweeps(run_set([other, *others]))
    with pytest.raises(ReportError, match="tau@cpu, .*tau 0.0: results differ in data"):
        sweeps(run_set([first, replace(first, fingerprint="other", run="other"), *others]))


def test_a_chart_has_readable_text():
    (made,) = charts(run_set(swept("tau"), protocol="sphere"))
    assert made.name == "sweep_tau_cpu" and made.png.startswith(b"\x89PNG")
    assert ">method.tau<" in made.svg and "WS-PSNR" in made.svg


def test_a_metric_without_values_has_no_panel():
    def without(one):
        metrics = {key: value for key, value in one.scores["paper"].metrics.items() if "lpips" not in key}
        return replace(one, scores={"paper": replace(one.scores["paper"], metrics=metrics)})

    (sweep,) = sweeps(run_set([without(one) for one in swept(seeds=1)]))
    assert [measure.name for measure in sweep.measures if "/" in measure.name] == ["paper/ssim", "paper/psnr"]
