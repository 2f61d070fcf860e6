"""A trained run that is small enough to search in a second or two."""

import shutil

import pytest
from rich.console import Console

import padgs
from padgs.multirun.composition import composing, configuration
from padgs.runs.run import run

SETTINGS = (
    "train.iterations=60",
    "data.generator.width=48",
    "data.generator.train_views=8",
    "data.generator.test_views=2",
    "data.generator.samples=1",
    "data.generator.points=300",
    "protocol=sphere",
    "protocol.sphere.lpips=none",
    "run.device=cpu",
    "run.threads=1",
    "run.pictures=false",
    "tracking=none",
)


@pytest.fixture(scope="session")
def settings():
    """Of a run on which a search takes a second or two."""
    return SETTINGS


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Of a method and more settings: the folder of a finished run."""
    found = {}

    def folder(*settings: str):
        if settings not in found:
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("PADGS_CACHE", str(tmp_path_factory.mktemp("cache")))
                runs = tmp_path_factory.mktemp("runs")
                with composing():
                    config = configuration([*SETTINGS, *settings, f"run.folder={runs}"])
                run(config, Console(quiet=True))
                found[settings] = next(path.parent for path in runs.glob("*/result.json"))
        return found[settings]

    return folder


@pytest.fixture
def opened(trained, tmp_path, monkeypatch):
    """Of a method and more settings: a copy of a finished run of its own, opened."""
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path / "cache"))

    def run(*settings: str):
        folder = trained(*settings)
        copy = tmp_path / folder.name
        if not copy.exists():
            shutil.copytree(folder, copy)
        return padgs.load_run(copy, device="cpu")

    return run
