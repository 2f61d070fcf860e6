"""The search for the smallest model: which counts it tries, and a whole search on a tiny run."""

import math
import shutil
from dataclasses import replace
from statistics import mean

import pytest
import torch
from rich.console import Console
from support.tiny_scene import tiny_scene
from typer.testing import CliRunner

import padgs
from padgs.checks import ConfigError
from padgs.cli.commands import app
from padgs.methods.anchors.method import PaDGSMethod
from padgs.multirun import job
from padgs.multirun.composition import composing, configuration
from padgs.results import SMALLEST_LOSSES, Scores
from padgs.runs import candidates as rules
from padgs.runs import smallest as search
from padgs.runs.candidates import (
    Candidate,
    band_shares,
    deciding_views,
    loss,
    lower_bound,
    next_count,
    objections,
)
from padgs.runs.interrupt import Interrupted
from padgs.runs.run import Callback, load_scene, run, start
from padgs.runs.smallest import Search, find_smallest
from padgs.scene import View

SETTINGS = (
    *("train.iterations=60", "data.generator.width=48", "data.generator.train_views=8", "data.generator.test_views=4"),
    *("data.generator.samples=1", "data.generator.points=300", "protocol=sphere", "protocol.sphere.lpips=none"),
    *("run.device=cpu", "run.threads=1", "tracking=none"),
)


def scores(*views: float, lpips: float | None = 0.1, **bands: float) -> Scores:
    """Scores of views with these WS-PSNRs, all bands alike except those that are given."""
    each: dict[str, dict[str, float | None]] = {
        str(number): {"ws_psnr": value, "ws_lpips_alex": lpips, "ws_lpips_vgg": lpips}
        | {f"ws_psnr_{band}": value + bands.get(band, 0.0) for band in rules.BANDS}
        for number, value in enumerate(views)
    }
    return Scores({}, {"ws_psnr": mean(views), "ws_lpips_alex": lpips}, each)


def candidate(rows: int, *views: float) -> Candidate:
    return Candidate("", rows, rows, rows, 1.0, scores(*views), 0.0, 0.0)


def view(mask: torch.Tensor | None = None) -> View:
    return View("0", torch.eye(4, dtype=torch.float64), 96, 48, load_mask=None if mask is None else lambda: mask)


SHARES = {str(number): band_shares(view()) for number in range(8)}


def shares(count: int) -> dict[str, dict[str, float]]:
    return {str(number): SHARES["0"] for number in range(count)}


def searched(quality) -> list[Candidate]:
    """Return all candidates of a search in which a model of N rows has `quality(N)` dB."""
    found: list[Candidate] = []
    count: int | None = 10_000
    while count is not None:
        found.append(candidate(count, *[quality(count)] * 3))
        count = next_count(found, SMALLEST_LOSSES, shares(3))
        assert len(found) < 60, "the search ends"
    return found


def test_the_smallest_model_of_each_loss_is_found_within_a_fifth():
    def lost(rows: int) -> float:
        return 0.3 * max(0.0, math.log2(5000 / rows)) ** 1.5

    found = searched(lambda rows: 33 - lost(rows))
    assert [one.rows for one in found[:3]] == [10_000, 7000, 4900] and loss(found, found[2]) == pytest.approx(
        lost(4900)
    )
    for epsilon in SMALLEST_LOSSES:
        true = min(rows for rows in range(100, 10_001) if lost(rows) < epsilon)
        assert true <= rules.smallest(found, epsilon, shares(3)).rows <= 1.2 * true + 1, epsilon


def test_a_search_ends_at_few_rows_if_none_is_needed_and_keeps_all_if_all_are():
    found = searched(lambda rows: 30.0)
    assert 130 <= found[-1].rows < 190
    found = searched(lambda rows: 30.0 - 100 * (rows < 10_000))
    assert all(rules.smallest(found, epsilon, shares(3)).rows == 10_000 for epsilon in SMALLEST_LOSSES)


@pytest.mark.parametrize(
    ("changed", "reasons"),
    [
        (scores(30.0, 30.0, 30.0), ()),
        (scores(29.95, 29.95, 29.95), ()),
        (scores(29.85, 29.85, 29.85), ("WS-PSNR may fall",)),
        (scores(30.2, 30.0, 29.8), ("WS-PSNR may fall",)),
        (scores(30.0, 30.0, 30.0, pole=-0.3), ("pole falls by 0.30 dB",)),
        (scores(30.0, 30.0, 30.0, lpips=0.106), ("LPIPS rises by 0.0060",)),
        (scores(30.9, 30.9, 29.4), ("WS-PSNR may fall", "a view falls by 0.60 dB")),
    ],
)
def test_each_rule_objects_by_name(changed, reasons):
    found = objections(changed, scores(30.0, 30.0, 30.0), 0.1, shares(3))
    assert len(found) == len(reasons) and all(map(str.startswith, found, reasons)), found


def test_exact_views_have_a_finite_loss():
    control, other = candidate(100, math.inf, math.inf, 40), candidate(50, math.inf, 60, 40)
    assert rules.loss([control], other) == pytest.approx(40 / 3), "100 dB at most, as in means"
    assert "may fall by nan" not in "".join(objections(other.scores, control.scores, 1.0, shares(3)))


def test_the_bound_is_that_of_students_t():
    # mean 0, s = 0.1, n = 3: t(0.95, 2) = 2.920; -2.920 * 0.1 / sqrt(3)
    assert lower_bound([0.1, 0.0, -0.1]) == pytest.approx(-0.16859, abs=1e-5)


def test_bands_count_by_what_masks_leave_of_them_and_small_ones_decide_nothing():
    """With its nadir masked, `nadir` and half of `pole` are noise."""
    whole, mask = band_shares(view()), torch.ones(48, 96)
    mask[40:] = 0
    masked = band_shares(view(mask))
    assert whole["pole"] == pytest.approx(0.034, abs=2e-3) and whole["equator"] == pytest.approx(0.5, abs=0.02)
    assert masked["nadir"] == 0 and masked["pole"] == pytest.approx(whole["pole"] / 2) and masked["zenith"] < 0.02
    control, worse = scores(30.0, 30.0, 30.0), scores(30.0, 30.0, 30.0, nadir=-1.33, zenith=-1.0, pole=-0.6)
    assert objections(worse, control, 0.1, shares(3)) == ("pole falls by 0.60 dB",)
    assert objections(worse, control, 0.1, dict.fromkeys("012", masked)) == ()
    of_one_view = scores(30.0, 30.0, 30.0)
    of_one_view.views["0"]["ws_psnr_pole"] = 29.0
    half = {**SHARES["0"], "pole": SHARES["0"]["pole"] / 10}
    assert objections(of_one_view, control, 0.1, shares(3)) == ("pole falls by 0.33 dB",)
    assert objections(of_one_view, control, 0.1, {**shares(3), "0": half}) == ()


def test_the_interval_of_the_minimal_count():
    found = [
        candidate(1000, 30.0, 30.0, 30.0),
        candidate(700, 30.0, 30.0, 30.0),  # surely as good
        candidate(500, 30.1, 29.9, 29.8),  # perhaps
        candidate(300, 29.5, 29.6, 29.5),  # surely not
    ]
    assert rules.smallest(found, 0.1, shares(3)).rows == 700
    assert rules.smallest_possible(found, 0.1).rows == 500


def test_fewer_test_views_than_three_are_refused_with_a_way_out():
    three = replace(tiny_scene(), test=tiny_scene().train[:3])
    assert deciding_views(three) is three.test
    with pytest.raises(
        ValueError, match="2 test views are too few .* at least 3 .* data.split=every data.test_every=4"
    ):
        deciding_views(replace(three, test=three.test[:2]))


@pytest.fixture(autouse=True)
def short(monkeypatch, cache):
    """Search few counts, without LPIPS."""
    monkeypatch.setattr(search, "RULES", replace(search.RULES, lpips="none"))
    monkeypatch.setattr(rules, "MIN_ROWS", 130)
    monkeypatch.setenv("PADGS_CACHE", str(cache))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return the folder of a finished run of a method, trained once."""
    folders = {}

    def folder(*settings: str):
        if settings not in folders:
            runs = tmp_path_factory.mktemp("runs")
            with composing():
                config = configuration([*SETTINGS, *settings, f"run.folder={runs}"])
            run(config, Console(quiet=True))
            folders[settings] = next(path.parent for path in runs.glob("*/result.json"))
        return folders[settings]

    return folder


@pytest.fixture
def load(finished, tmp_path):
    """Load a copy of a finished run of a method."""

    def loaded(*settings: str):
        folder = finished(*settings)
        copy = tmp_path / folder.name
        if not copy.exists():
            shutil.copytree(folder, copy)
        return padgs.load_run(copy, device="cpu")

    return loaded


@pytest.mark.parametrize("method", [pytest.param("omnigs", marks=pytest.mark.slow), "padgs"])
def test_a_search_writes_what_it_found_and_keeps_the_smallest_model_as_a_run(load, method):
    loaded = load(f"method={method}")
    with (console := Console(width=200)).capture() as shown:
        result = find_smallest(loaded, 1.0, console)
    found = result.smallest
    rows = [step["rows"] for step in found["steps"]]
    assert found["row"] == ("anchors" if method == "padgs" else "gaussians") and rows[0] == found["rows"] == max(rows)
    assert found["steps"][0]["loss"] == 0 and rows[1] == math.ceil(0.7 * rows[0])
    assert load(f"method={method}").result == result and "smallest" in result.experiments
    assert result.scores == loaded.result.scores and result.config == loaded.result.config
    kept = padgs.load_run(loaded.folder.with_name(found["kept"]["run"]), device="cpu")
    assert kept.method.model.counts()[found["row"]] == rows[found["minimal"]["1"]]
    assert kept.result is not None and kept.result.ok and kept.result.variant.startswith("smallest 1 dB")
    assert kept.score("sphere").metrics == pytest.approx(kept.scores["sphere"].metrics, nan_ok=True)
    assert "1 dB" in shown.get() and kept.folder.name in shown.get()
    views = [view.name for view in loaded.scene.test]
    assert found["views"] == views and f"Decided by {len(views)} test views" in " ".join(shown.get().split())
    assert found["ws_psnr"] == pytest.approx(loaded.result.scores["sphere"].metrics["ws_psnr"])
    control, *others = found["steps"]
    assert all(step["loss"] == pytest.approx(control["ws_psnr"] - step["ws_psnr"]) for step in others)
    assert found["possible"].keys() == found["minimal"].keys()
    assert "interval" in shown.get() and f"–{rows[found['minimal']['1']]}" in shown.get()
    candidates = sorted((loaded.folder / "smallest").glob("*/result.json"))
    written = [path.stat().st_mtime_ns for path in candidates]
    again = find_smallest(load(f"method={method}"), 0.1, Console(quiet=True)).smallest
    assert again["steps"] == found["steps"] and again["kept"]["epsilon"] == 0.1, "candidates are not trained again"
    assert [path.stat().st_mtime_ns for path in candidates] == written


def test_a_candidate_that_failed_is_tried_again(load, monkeypatch):
    monkeypatch.setattr(rules, "MIN_ROWS", 10**9)  # one candidate will do
    fit = PaDGSMethod.fit
    with monkeypatch.context() as patch:
        patch.setattr(PaDGSMethod, "fit", lambda *_: failing())
        with pytest.raises(ValueError, match=r"ended with status oom .*; padgs smallest .* tries it again"):
            Search(load("method=padgs"), Console(quiet=True)).complete()
    assert PaDGSMethod.fit is fit
    again = Search(load("method=padgs"), Console(quiet=True))
    again.complete()
    assert again.candidates


def failing():
    raise MemoryError("for the test")


def test_an_interrupted_search_resumes_to_the_same_candidates(load):
    whole = Search(load("method=padgs"), Console(quiet=True))
    whole.complete()
    shutil.rmtree(whole.run.folder / "smallest")
    stops, looks = 0, 0

    def stop_requested() -> bool:
        nonlocal looks
        looks += 1
        return looks % 10 == 0

    while True:
        again = Search(load("method=padgs"), Console(quiet=True), stop_requested)
        try:
            again.complete()
            break
        except Interrupted:
            stops += 1
    assert stops > 1
    for one, other in zip(whole.candidates, again.candidates, strict=True):
        assert (one.run, one.rows, one.scores) == (other.run, other.rows, other.scores)


def test_a_warm_start_prunes_the_least_important_rows_to_its_budget_and_refinement_keeps_their_number(load, tmp_path):
    folder = load("method=omnigs").folder
    for more in ([], ["train.refine=true"]):
        settings = [*SETTINGS, "method=omnigs", f"init={folder}", "budget.gaussians=100", *more]
        with composing():
            config = configuration([*settings, f"run.folder={tmp_path}/{len(more)}"])
        result = run(config, Console(quiet=True))
        assert result.ok and result.counts["start"] == 100 >= result.counts["gaussians"]
        assert not more or result.counts["gaussians"] == 100
    with composing():
        config = configuration([*SETTINGS, "method=omnigs", "train.refine=true", f"run.folder={tmp_path}/none"])
    assert "set init=RUN" in run(config, Console(quiet=True)).reason


def refused(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["smallest", *map(str, arguments)])
    assert result.exit_code == 1, result.output
    return " ".join(result.stderr.split())


def test_runs_that_cannot_be_searched_are_refused_with_a_way_out(load, tmp_path):
    loaded = load("method=omnigs")
    assert "has no config.yaml; give the folder of one run" in refused(tmp_path)
    assert "--epsilon is 0.3; it must be one of 0.05, 0.1" in refused(loaded.folder, "--epsilon", "0.3")
    moved = refused(loaded.folder, "--data", str(tmp_path / "gone"))
    assert f"it is the data of {loaded.folder}: if it has moved" in moved
    (loaded.folder / "result.json").rename(loaded.folder / "elsewhere")
    assert "is not finished" in refused(loaded.folder)
    shutil.rmtree(loaded.folder / "checkpoint")
    assert "has no checkpoint" in refused(loaded.folder)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (("method=egonerf_small",), "EgoNeRF has no Gaussians to prune"),
        (("method=sc_omnigs",), "cameras"),
        (("method=cubemap_3dgs",), "views are cut from all panoramas"),
        (("train.exposures=learned",), "exposures or cameras are learned here"),
        (("smallest=yes",), "known: off, on"),
    ],
)
def test_methods_without_gaussians_or_with_learned_cameras_are_refused_before_training(settings, reason):
    with composing(), pytest.raises(ConfigError, match=reason):
        configuration(["smallest=on", *settings])


def test_a_run_with_smallest_on_is_the_same_run_and_is_searched_at_its_end(tmp_path, capsys):
    settings = (*SETTINGS, "method=padgs", "smallest=on", f"run.folder={tmp_path}")
    with composing():
        config = configuration(settings)
        assert config.values() == configuration([*settings, "smallest=off"]).values()
    scene = load_scene(config, start(config))
    result = run(config, Console(width=400), scene=scene)
    job.search_smallest(config, scene, result, Console(width=400), Callback())
    searched_run = padgs.load_run(tmp_path / result.run, device="cpu").result
    assert searched_run is not None
    kept = searched_run.smallest["kept"]
    assert kept["epsilon"] == 0.1 and kept["run"] in capsys.readouterr().out


def test_a_budget_of_pad_gs_counts_anchors(finished, tmp_path):
    whole = padgs.load_run(finished("method=padgs"), device="cpu").result
    assert whole is not None
    for budget, status in ((whole.counts["start"] + 1, "ok"), (10, "rejected")):
        with composing():
            config = configuration(
                [
                    *SETTINGS,
                    "method=padgs",
                    f"budget.gaussians={budget}",
                    f"run.folder={tmp_path}",
                    "train.iterations=150",
                ]
            )
        result = run(config, Console(quiet=True))
        assert result.status == status and (status == "ok" or "training starts with" in result.reason)
        assert result.counts.get("anchors", 0) <= budget
