"""Cells of the matrix that stand for the others: padgs_plus on the built-in room, small, and a number each.

What a cell may cost is some way above what it costs today (LOG.md, 2026-11-22), so that luck breaks none of them.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
import torch
from composed import composed

from padgs.runs.scoring import scores
from padgs.runs.session import build, scene_of
from padgs.training.failure import Failure

pytestmark = pytest.mark.slow
SMALL = ("data.generator.width=64", "data.generator.train_views=16", "data.generator.test_views=1")
LENGTH = ("data.generator.points=3000", "data.generator.samples=4", "train.iterations=200", "run.threads=1")


@pytest.fixture(autouse=True)
def cached(monkeypatch, root, cache):
    monkeypatch.setenv("PADGS_ROOT", str(root))
    monkeypatch.setenv("PADGS_CACHE", str(cache))


@cache
def marks(condition: str = "none", level: int = 1, *more: str) -> dict[str, Any]:
    """The marks of a run and how many Gaussians it has."""
    stress = (f"stress.condition={condition}", f"stress.level={level}")
    config = composed(*SMALL, *LENGTH, "protocol=stability", "protocol.stability.lpips=none", *stress, *more)
    torch.manual_seed(0)
    scene, method = scene_of(config, torch.device("cpu")), build(config)
    list(method.fit(scene, config.time))
    found = scores(method, scene, config.protocols, None)["stability"].metrics
    return {**found, "gaussians": method.size().counts["gaussians"]}


def lost(condition: str, level: int) -> float:
    """WS-PSNR that a condition costs, dB."""
    return marks()["ws_psnr"] - marks(condition, level)["ws_psnr"]


def test_the_world_may_be_turned():
    assert abs(lost("world_rotation", 2)) < 0.3


def test_the_seam_may_lie_anywhere():
    assert abs(lost("seam", 2)) < 0.3
    assert marks("seam", 2)["seam"] < 1.5 and marks("seam", 2)["yaw_error"] < 1e-3


def test_the_world_may_have_any_unit():
    for level in (1, 3):
        assert abs(lost("world_scale", level)) < 0.2
        assert marks("world_scale", level)["gaussians"] == pytest.approx(marks()["gaussians"], rel=0.02)


def test_a_hundredth_of_the_points_is_enough_to_begin_with():
    assert lost("few_points", 2) < 1.5


def test_a_quarter_of_the_views_does_not_collapse():
    assert lost("few_views", 2) < 2 and marks("few_views", 2)["depth_error"] < 0.3


def test_no_detail_at_the_poles_is_lost_that_an_even_blur_would_keep():
    for spokes, dB in ((4, 1), (16, 2)):
        poles = marks("none", 1, "data.generator.scene=pole_torture", f"data.generator.spokes={spokes}")
        assert poles["ws_psnr_equator"] - poles["ws_psnr_pole"] - poles["pole_gap_oracle"] < dB


@pytest.mark.parametrize("level", [1, 2])
def test_networks_may_multiply_in_fewer_bits(level):
    rest, reduced = (marks(name, level, "method=padgs_small")["ws_psnr"] for name in ("none", "precision"))
    assert 0 < abs(rest - reduced) < 0.3


def test_rates_ten_times_as_high_end_without_a_nan():
    assert lost("learning_rates", 1) < 0.5
    try:
        lost("learning_rates", 2)
    except Failure as failure:
        assert failure.status != "nan"
