"""Runs opened from Python: what they show, how they score, and what is wrong with folders that are none."""

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from rich.console import Console
from support.fixtures import make_world, write_colmap_text
from support.tiny_run import tiny_run

import padgs
from padgs.checks import ConfigError
from padgs.data.camera_paths import PATHS
from padgs.data.capture import DataError
from padgs.data.datasets import refuse_missing
from padgs.geometry.camera import Panorama, perspective
from padgs.geometry.panorama import sample
from padgs.multirun.composition import composing, configuration
from padgs.results import read
from padgs.runs import load
from padgs.runs.load import missing_backends
from padgs.runs.run import run as train
from padgs.runs.store import RunFolderError, config_hash


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tiny_run(tmp_path_factory)


def test_a_run_has_its_name_wherever_one_stands(folder, monkeypatch):
    (folder / "renders").mkdir(exist_ok=True)
    for place, path in ((folder, "."), (folder / "renders", "..")):
        monkeypatch.chdir(place)
        assert padgs.load_run(path, device="cpu").folder.name == folder.name


def test_an_opened_run_shows_and_scores_what_was_trained(folder):
    run = padgs.load_run(folder, device="cpu")
    assert run.result == read(folder / "result.json") and run.scores == run.result.scores
    again = run.score("sphere")
    assert again.metrics == pytest.approx(run.scores["sphere"].metrics, nan_ok=True)
    view = run.scene.test[0]
    picture = run.render(view)
    assert [part.dtype for part in (picture.image, picture.depth, picture.alpha)] == [np.float32] * 3
    assert picture.image.shape == (16, 32, 3) and picture.depth.shape == picture.alpha.shape == (16, 32)
    for part in (picture.image, picture.alpha):
        assert part.min() >= 0 and part.max() <= 1
    assert picture.depth[picture.alpha > 0.5].min() > 0
    truth = view.image().numpy()
    assert np.square(picture.image - truth).mean() < np.square(truth - truth.mean()).mean(), "better than grey"


def test_a_path_begins_and_ends_among_the_training_cameras(folder):
    run = padgs.load_run(folder, device="cpu")
    views = run.camera_path(5)
    assert len({view.name for view in views}) == len(views) == 5
    assert torch.equal(torch.stack([view.cam_from_world for view in views]), PATHS["cameras"](run.scene, 5))
    assert run.render(views[1]).image.shape == (16, 32, 3)


@pytest.mark.parametrize("method", ["spags_sorted", "padgs_plus"])  # exact for every camera
def test_other_cameras_see_the_same(tmp_path_factory, method):
    run = padgs.load_run(tiny_run(tmp_path_factory, f"method={method}"), device="cpu")
    lens, fine, view = perspective(32, 32, 60.0), Panorama(256, 128), run.scene.train[0]
    seen = run.through(lens).render(replace(view, width=32, height=32, lens=lens)).image
    panorama = run.through(fine).render(replace(view, width=256, height=128)).image
    assert (seen - sample(panorama, lens.rays())).abs().mean() < 0.01 < seen.std()
    trained = sample(run.method.render(view).image, lens.rays())
    assert (seen - trained).abs().mean() < 0.65 * trained.std(), "not blurred, which would be 0.8"


def test_what_draws_panoramas_only_draws_other_cameras_by_pinhole(folder):
    run = padgs.load_run(folder, device="cpu")
    view, fine = run.scene.train[0], Panorama(256, 128)
    assert run.through(view.camera) is run.method and run.method.render_config.projection == "erp"
    assert run.through(fine).render_config.low_pass == pytest.approx(64 * run.method.render_config.low_pass)
    lens = perspective(16, 8, 90.0)
    drawn = run.through(lens)
    assert (drawn.render_config.projection, drawn.render_config.low_pass_kind) == ("pinhole", "angular")
    assert drawn.render(replace(view, width=16, height=8, lens=lens)).image.isfinite().all()


def test_finer_pixels_have_fewer_samples_as_close_together(tmp_path_factory):
    overrides = "method=spags_supersampled", "render.supersampling=4"
    run = padgs.load_run(tiny_run(tmp_path_factory, *overrides), device="cpu")
    trained = run.method.render_config
    view = run.scene.train[0]
    for times, samples in ((1, 4), (1.25, 4), (2, 2), (3, 2), (4, 1), (8, 1)):
        camera = Panorama(round(times * view.width), round(times * view.height))
        config = run.through(camera).render_config
        assert config.supersampling == samples
        pitch = (times * samples / trained.supersampling) ** 2  # of samples, which have the angle of the low-pass
        assert config.low_pass == pytest.approx(trained.low_pass * pitch)
    finer = run.through(Panorama(4 * view.width, 4 * view.height))
    image = finer.render(replace(view, width=4 * view.width, height=4 * view.height)).image
    mean = image.view(view.height, 4, view.width, 4, 3).mean((1, 3))
    torch.testing.assert_close(run.method.render(view).image, mean, atol=1e-5, rtol=0)


def test_a_run_of_a_gpu_opens_without_one(folder, tmp_path, monkeypatch):
    copy = tmp_path / "run"
    shutil.copytree(folder, copy)
    settings = (copy / "config.yaml").read_text()
    trained = config_hash(yaml.safe_load(settings))
    monkeypatch.setattr("padgs.runs.load.config_hash", lambda _: trained)
    (copy / "config.yaml").write_text(settings.replace("backend: auto", "backend: cuda"))
    run = padgs.load_run(copy, device="cpu")
    assert "backend: cuda" in (copy / "config.yaml").read_text() and run.config.render.backend == "auto"
    assert run.render(run.scene.test[0]).image.max() > 0


def test_backends_stay_where_they_can_render(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert [missing_backends(device) for device in ("auto", "cpu", "cuda")] == [set(), {"cuda"}, {"cpu"}]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert [missing_backends(device) for device in ("auto", "cpu")] == [{"cuda"}, {"cuda"}]


def test_an_unfinished_run_is_loaded(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "run")
    (copy / "result.json").unlink()
    run = padgs.load_run(copy)
    assert run.result is None and run.scores == {}
    assert run.notes == ("the run has not ended; its model is that of iteration 30",)
    assert run.method.size().counts["gaussians"] > 0
    assert padgs.load_run(folder).notes == ()


@pytest.mark.parametrize(
    ("file", "old", "new", "error"),
    [
        ("config.yaml", "seed: 0\nrender", "seed: 0\nrender", None),
        ("config.yaml", "iterations: 30", "iterations: 31", "is of a run with another configuration"),
        (
            "config.yaml",
            "\nseed: 0\n",
            "\nseed: 0\nnew: 1\n",
            "config.yaml: unknown key new; .*: use that version, or train",
        ),
        ("config.yaml", "data:\n", "date:\n", "is not a configuration of padgs-run"),
        ("config.yaml", "data:\n", "data: [\n", "is not a configuration of padgs-run"),
        ("config.yaml", "variant: ''", "variant: ${x", "is not a configuration of padgs-run"),
        ("checkpoint/state.json", '"iteration": 30', '"iteration": 29', "was changed after it was written"),
    ],
)
def test_a_run_that_was_edited_is_refused(folder, tmp_path, file, old, new, error):
    copy = shutil.copytree(folder, tmp_path / "run")
    path = copy / file
    path.write_text(path.read_text().replace(old, new))
    if error is None:
        assert padgs.load_run(copy).result.ok
        return
    with pytest.raises((RuntimeError, ConfigError), match=error):
        padgs.load_run(copy)


def test_changed_data_warn_when_shown_and_are_refused_when_compared(folder):
    run = padgs.load_run(folder, device="cpu")
    run.refuse_other_data()
    run = padgs.load_run(folder, device="cpu")
    run.result = replace(run.result, fingerprint="other")
    with pytest.warns(UserWarning, match="was trained on other data than the generator holds"):
        assert run.scene.train
    with pytest.raises(DataError, match="pass the right folder with --data"):
        run.refuse_other_data()


def test_data_named_from_the_folder_where_training_began_are_found(tmp_path, monkeypatch):
    (tmp_path / "work" / "here").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "work")
    write_colmap_text(make_world(), tmp_path / "work" / "photographs")
    Image.new("L", (64, 32), 255).save("all.png")
    with composing():
        options = [
            "data.mask=all.png",
            "data.path=photographs",
            "data.format=colmap",
            "data.width=32",
            "protocol=sphere",
            "tracking=none",
        ]
        config = configuration([*options, "protocol.sphere.lpips=none", "train.iterations=2", "method=omnigs"])
    trained = Path("runs", train(config, Console(quiet=True)).run).absolute()
    assert padgs.load_run(trained, device="cpu").config.data.path == "photographs", "as it was given"
    for folder in (tmp_path, tmp_path / "work" / "here", Path("/")):
        monkeypatch.chdir(folder)
        run = padgs.load_run(trained, device="cpu")
        assert run.scene.fingerprint == run.result.fingerprint
        run.refuse_other_data()
        assert all(view.mask() is not None for view in run.scene.train)


@pytest.mark.parametrize(("named", "opened"), [("here", "here"), ("gone", "auto"), ("off", "off"), ("auto", "auto")])
def test_a_disk_cache_of_the_machine_that_trained_is_made_anew_elsewhere(folder, tmp_path, named, opened):
    copy = shutil.copytree(folder, tmp_path / "run")
    (tmp_path / "here").mkdir()
    places = {name: str(tmp_path / name) for name in ("here", "gone")}
    settings = (copy / "config.yaml").read_text()
    assert "disk_cache: auto" in settings
    (copy / "config.yaml").write_text(settings.replace("disk_cache: auto", f"disk_cache: '{places.get(named, named)}'"))
    assert padgs.load_run(copy, device="cpu").config.data.disk_cache == places.get(opened, opened)


@pytest.fixture
def closed(tmp_path, monkeypatch) -> Path:
    """A folder of somebody else; the permissions of a real one do not hold for root."""
    looked_up, place = os.stat, tmp_path / "closed"

    def look_up(path, *arguments, **options):
        if str(path).startswith(f"{place}/"):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return looked_up(path, *arguments, **options)

    place.mkdir()
    monkeypatch.setattr(os, "stat", look_up)
    return place


def test_data_behind_a_closed_folder_are_missing_and_leave_the_configuration_readable(folder, tmp_path, closed):
    place, copy = closed / "photographs", shutil.copytree(folder, tmp_path / "run")
    run = padgs.load_run(copy, data_path=place, device="cpu")
    with pytest.raises(DataError, match=f"{place} does not exist; give the folder of panoramas"):
        assert run.scene
    assert load._found("all.png", [place, tmp_path]) == "all.png"
    (tmp_path / "all.png").touch()
    assert load._found("all.png", [place, tmp_path]) == str(tmp_path / "all.png")


def test_published_data_behind_a_closed_folder_are_missing(closed):
    for place in (closed / "360roam" / "bar", closed / "bar"):
        with pytest.raises(DataError, match="is missing. Get it from .*, and put it into "):
            refuse_missing(place, "roam360")


def test_words_are_no_names_of_folders_and_masks_may_be_inverted(tmp_path):
    for name in ("auto", "random", "none", "inverted", "people"):
        (tmp_path / name).mkdir()
    for word in ("auto", "random", "none", "inverted", "inverted:auto", "", None):
        assert load._found(word, [tmp_path]) == word
    assert load._found("inverted:people", [tmp_path]) == f"inverted:{tmp_path / 'people'}"
    assert load._found("lost", [tmp_path]) == "lost"


def test_what_is_no_run_is_refused_with_a_way_out(folder, tmp_path):
    with pytest.raises(RunFolderError, match="has no config.yaml; give the folder of one run"):
        padgs.load_run(tmp_path)
    shutil.copy(folder / "result.json", tmp_path)
    with pytest.raises(
        RunFolderError, match="has no config.yaml: the same padgs-run restores it; a model from elsewhere"
    ):
        padgs.load_run(tmp_path)
    shutil.copy(folder / "config.yaml", tmp_path)
    with pytest.raises(RunFolderError, match="has no checkpoint"):
        padgs.load_run(tmp_path)
    with pytest.raises(ValueError, match="unknown protocol 'papre'; known: paper, sphere"):
        padgs.load_run(folder).score("papre")
    with pytest.raises(ValueError, match="^unknown device 'gpu'; known: auto, cpu, cuda; did you mean cpu"):
        padgs.load_run(folder, device="gpu")
