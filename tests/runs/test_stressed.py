"""Runs under stress, from the configuration to the result."""

import io
from dataclasses import asdict, replace
from functools import partial

import pytest
import torch
from rich.console import Console
from support.composed import composed
from support.made_up import result
from support.tiny_scene import tiny_scene

from padgs.evaluation.protocols import Protocol
from padgs.evaluation.scoring import constant_color_quality
from padgs.results import Scores
from padgs.runs import run as pipeline
from padgs.runs.run import judge
from padgs.scene import Scene


def depth_of(distance: float) -> torch.Tensor:
    return torch.full((16, 32), distance)


def with_depth(distance: float) -> Scene:
    scene = tiny_scene()
    return replace(scene, test=tuple(replace(view, load_depth=partial(depth_of, distance)) for view in scene.test))


@pytest.fixture(autouse=True)
def tiny(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))
    monkeypatch.setattr(pipeline.data, "load", lambda path, format, options: with_depth(3.0))


@pytest.fixture
def run(tmp_path):
    def ran(*settings: str):
        small = ("train.iterations=120", "train.check_every=20", "method=omnigs", "protocol=stability")
        config = composed(f"run.folder={tmp_path}/runs", *small, *settings)
        out = io.StringIO()
        return pipeline.run(config, Console(file=out, width=200)), out.getvalue()

    return ran


def test_a_run_says_what_it_is_stressed_by_and_has_marks_that_show_harm(run):
    made, said = run("stress.condition=few_views", "stress.level=1")
    assert made.ok and made.variant == "few_views 1" and made.config["stress"] == {"condition": "few_views", "level": 1}
    assert "omnigs (few_views 1) on tiny: 3 training" in said and "stress: one of 2 training views is left" in said
    assert "_few-views-1_" in made.run
    marks = made.scores["stability"].metrics
    assert marks["ws_psnr"] > marks["ws_psnr_one_color"] and marks["ws_psnr_training"] > 0
    assert 0 < marks["depth_error"] < 0.5 and marks["yaw_error"] < 1e-4
    assert marks["pole_gap_oracle"] < -20  # its poles are nearly empty
    assert marks["ws_psnr_fitted"] > marks["ws_psnr"] and marks["least_extent"] > 0.01
    assert run("stress.condition=few_views", "stress.level=1")[0] == made  # found again


def test_methods_that_learn_cameras_have_no_marks_of_training_views(run):
    marks = run("train.exposures=learned", "train.iterations=10")[0].scores["stability"].metrics
    assert marks["ws_psnr_training"] is None and marks["yaw_error"] is None and marks["depth_error"] > 0


def test_rows_that_do_not_count_count_in_no_mark(run, tmp_path):
    marks = [
        run(f"protocol.stability.bottom_crop={crop}", "train.iterations=60", f"run.folder={tmp_path}/{crop}")[0]
        .scores["stability"]
        .metrics
        for crop in (0.0, 0.5)
    ]
    for name in ("ws_psnr", "ws_psnr_one_color", "ws_psnr_fitted"):
        assert abs(marks[0][name] - marks[1][name]) > 1e-3, name


@pytest.mark.parametrize("method", ["omnigs", "spags_sorted", "padgs", "padgs_plus"])
def test_rates_a_thousand_times_as_high_never_end_well(run, method):
    made, said = run(f"method={method}", "train.learning_rates=1000")
    assert made.status not in ("ok", "rejected") and made.reason in said.replace("\n", " ")


def test_a_protocol_may_ask_for_less(run):
    marks = run("protocol.stability.metrics=[seam]")[0].scores["stability"].metrics
    assert marks["seam"] > 0 and marks["ws_psnr_training"] is None and "ws_psnr" not in marks


def test_wrong_depths_are_degenerate(run, monkeypatch):
    monkeypatch.setattr(pipeline.data, "load", lambda path, format, options: with_depth(0.3))
    assert run()[0].ok, "tables of quality have it, whether the stress suite scored it or not"
    made, said = run("stress.condition=few_views", "stress.level=1")
    assert made.status == "degenerate" and "(AbsRel), more than 50%" in made.reason
    assert made.scores["stability"].metrics["depth_error"] > 0.5 and "degenerate" in said


@pytest.mark.parametrize(
    ("better", "depth_error", "least_extent", "iterations", "status"),
    [
        (-0.1, None, None, 50, "diverged"),
        (-0.1, None, None, 49, "ok"),  # too soon to say
        (5.0, 0.51, 0.5, 50, "degenerate"),
        (5.0, 0.4, 0.009, 50, "degenerate"),
        (5.0, 0.4, 0.011, 50, "ok"),
        (5.0, None, None, 50, "ok"),
    ],
)
def test_results_are_judged_by_what_they_show(better, depth_error, least_extent, iterations, status):
    """Worse than one colour, under any protocol; depths where they are known."""
    scene, protocol = tiny_scene(), Protocol("half", ("ws_psnr",), "none", "11", solid_angle=True, bottom_crop=0.5)
    black = replace(scene.test[0], name="black", load_pixels=lambda: torch.zeros(16, 32, 3, dtype=torch.uint8))
    scene = replace(scene, test=(*scene.test, black))
    one_color = constant_color_quality(scene, protocol)
    assert one_color.keys() == {view.name for view in scene.test} - {"black"}, "its own colour has endless decibels"
    assert one_color != constant_color_quality(scene, replace(protocol, bottom_crop=0.0))
    views = {name: {"ws_psnr": value + better} for name, value in one_color.items()} | {"black": {"ws_psnr": 30.0}}
    marks = {"ws_psnr": 30.0, "depth_error": depth_error, "least_extent": least_extent}
    config = {"stress": {"condition": "few_views", "level": 1}}
    made = replace(result(), config=config, scores={"half": Scores(asdict(protocol), marks, views)})
    assert judge(made, scene, iterations).status == status
    assert judge(replace(made, status="timeout"), scene, iterations).status == "timeout"
    assert judge(result(), scene, iterations).ok, "without marks"
