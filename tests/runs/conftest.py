"""A configuration of a run on the tiny scene, for tests of what a run does."""

from dataclasses import replace

import pytest
from support.composed import composed
from support.tiny_scene import tiny_scene
from support.training import ITERATIONS, SMALL

from padgs.runs import run as pipeline


@pytest.fixture
def tiny(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))
    monkeypatch.setattr(pipeline.data, "load", lambda path, format, options: tiny_scene())


@pytest.fixture
def config(tmp_path, tiny):
    config = composed(*SMALL, f"train.iterations={ITERATIONS}", "run.log_every=2", "run.probe_every=5")
    return replace(config, run=replace(config.run, folder=f"{tmp_path}/runs"))
