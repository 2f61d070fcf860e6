"""Structure from motion, against exact poses and against models of real panoramas; interruption, masks, bad input."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

import padgs.data
from padgs.cli.commands import app
from padgs.data import DataError
from padgs.data.camera_paths import gravity, path_length
from padgs.data.check import check
from padgs.data.metres import KnownLength
from padgs.data.prepare import pipeline, sfm, work
from padgs.data.prepare.pipeline import prepare
from padgs.data.prepare.work import PrepareOptions
from padgs.data.synthetic import SyntheticOptions, generate
from padgs.training.corrections import align

VIEWS = 6


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a synthetic scene, and its panoramas in a folder with a space in its name."""
    folder = tmp_path_factory.mktemp("room é 1")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PADGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        options = SyntheticOptions(path="line", width=512, train_views=VIEWS, test_views=0, samples=4, points=10)
        scene = generate(options)
        for view in scene.train:
            Image.fromarray(view.load_pixels().numpy()).save(folder / f"pano {view.name}.png")
    return scene, folder


@pytest.fixture(scope="module")
def prepared(scene, tmp_path_factory):
    """Return the result of an uninterrupted call, and its progress calls."""
    out, calls = tmp_path_factory.mktemp("out") / "done", []
    result = prepare(scene[1], out, PrepareOptions(threads=1), lambda *step: calls.append(step))
    return result, out, calls


def differences(folder, reference):
    """Return distances [F], degrees [F] and path length of a prepared folder against exact poses by name."""
    frames = padgs.data.read(folder).frames
    found = torch.stack([frame.cam_from_world for frame in frames])
    exact = torch.stack([reference[frame.name] for frame in frames])
    _, left = align(exact, found)
    return left.distance, left.degrees, path_length(exact)


def test_a_misspelt_camera_is_refused_before_any_work(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(sfm, "extract_features", None)
    name = next(iter(scene[1].glob("*.png"))).name
    with pytest.raises(DataError, match="--metres: no panorama with a pose is called 'nobody'; known: pano"):
        prepare(scene[1], tmp_path / "out", PrepareOptions(known=KnownLength(metres=(name, "nobody", 3.0))))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("", PrepareOptions(known=KnownLength(gps=True)), "--gps: 0 of 6 images have a GPS position"),
        ("", PrepareOptions(per_second=5.0), "--per-second 5: .* is no video; leave it out"),
        ("v.mp4", PrepareOptions(known=KnownLength(gps=True)), "--gps: frames of a video have no GPS"),
        ("v.mp4", PrepareOptions(mask="inverted"), "a video has no masks of its own; give their path"),
    ],
)
def test_options_that_the_input_lacks_are_refused_before_any_work(scene, tmp_path, monkeypatch, name, options, message):
    for module, work_of in ((sfm, "extract_features"), (pipeline, "extract_frames")):
        monkeypatch.setattr(module, work_of, None)
    source = tmp_path / name if name else scene[1]
    if name:
        source.touch()
    with pytest.raises(DataError, match=message):
        prepare(source, tmp_path / "out", options)
    assert not (tmp_path / ".out.prepare").exists()


def test_another_mapper_keeps_features_and_matches(scene, tmp_path, monkeypatch):
    """Also check that the first mapper's model is not taken for that of the second."""
    calls = []

    def fail(database, folder, parts, *rest):
        calls.append(rest[-1])
        raise RuntimeError("stop")

    monkeypatch.setattr(sfm, "reconstruct", fail)
    source = noise(tmp_path / "in")
    for mapper in ("incremental", "global"):
        with pytest.raises(DataError, match="stop"):
            prepare(source, tmp_path / "out", PrepareOptions(threads=1, mapper=mapper))
        monkeypatch.setattr(sfm, "extract_features", None)
    (tmp_path / ".out.prepare" / "poses.done").write_text("incremental")
    with pytest.raises(DataError, match="stop"):
        prepare(source, tmp_path / "out", PrepareOptions(threads=1, mapper="global"))
    assert calls == ["incremental", "global", "global"]


def test_a_finished_result_is_reused(scene, prepared):
    result, out, _ = prepared
    written = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    again = prepare(scene[1], out, PrepareOptions(threads=2))
    assert again == replace(result, seconds={}) and written == {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    with pytest.raises(DataError, match="was not made of"):
        prepare(scene[1], out, PrepareOptions(level=False))


def test_exact_poses_are_found(scene, prepared):
    result, out, _ = prepared
    reference = {f"pano {view.name}.png": view.cam_from_world for view in scene[0].train}
    assert result.registered == tuple(sorted(reference))
    assert result.unregistered == ()
    distance, degrees, length = differences(out, reference)
    assert length > 2
    assert distance.max() < 1e-3 * length  # 0.1 % of the path
    assert distance.max() < 4e-3  # metres
    assert degrees.max() < 0.08


def test_the_result_is_level_complete_and_ready(prepared):
    result, out, calls = prepared
    assert sorted(path.name for path in out.iterdir()) == ["images", "prepare.json", "sparse"]
    assert sorted(path.name for path in out.parent.iterdir()) == ["done"]  # no working folder left
    poses = torch.stack([frame.cam_from_world for frame in padgs.data.read(out).frames])
    assert gravity(poses).axis == "+z"
    assert gravity(poses).off_axis < 0.01
    stated = json.loads((out / "prepare.json").read_text(encoding="utf-8"))
    assert stated["points"] == result.points > 300
    assert check(out).problems == []
    last = {step: (done, total) for step, done, total in calls}
    pairs = VIEWS * (VIEWS - 1) // 2
    assert last == {"features": (VIEWS,) * 2, "matches": (pairs,) * 2, "poses": (VIEWS,) * 2, "result": (1, 1)}


@pytest.mark.slow
def test_an_interrupted_call_resumes_with_the_same_result(scene, prepared, tmp_path):
    """Use one thread, because with several the last bits of poses depend on timing."""
    out = tmp_path / "done"

    def interrupt(step, done, total):
        if step == "matches":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(scene[1], out, PrepareOptions(threads=1), interrupt)
    assert not out.exists()
    calls = []
    prepare(scene[1], out, PrepareOptions(threads=1), lambda *step: calls.append(step[0]))
    assert "features" not in calls
    for path in (prepared[1] / "sparse" / "0").iterdir():
        assert (out / "sparse" / "0" / path.name).read_bytes() == path.read_bytes(), path.name


def test_images_are_linked_again_where_their_source_has_moved(scene, prepared, tmp_path):
    first, out = shutil.copytree(scene[1], tmp_path / "first"), tmp_path / "out"

    def interrupt(step, done, total):
        if step == "features":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(first, out, PrepareOptions(threads=1), interrupt)
    first.rename(tmp_path / "second")
    assert len(prepare(tmp_path / "second", out, PrepareOptions(threads=1)).registered) == len(prepared[0].registered)


def test_a_wrong_source_is_not_blamed_on_the_result(scene, prepared, tmp_path):
    with pytest.raises(DataError, match="absent is not a folder; give a folder of panoramas"):
        prepare(tmp_path / "absent", prepared[1], PrepareOptions(threads=1))


def test_other_input_starts_over(scene, tmp_path):
    """Check that a working folder is reused only for the same images and options."""
    out, work = tmp_path / "done", tmp_path / ".done.prepare"

    def interrupt(step, done, total):
        raise KeyboardInterrupt

    some = tmp_path / "some"
    some.mkdir()
    for index in range(2):
        shutil.copy(scene[1] / f"pano 00{index}.png", some)
    for options in (PrepareOptions(threads=1), PrepareOptions(threads=1, seed=1)):
        with pytest.raises(KeyboardInterrupt):
            prepare(some, out, options, interrupt)
        assert not (work / "stale").exists()
        (work / "stale").touch()
    with pytest.raises(KeyboardInterrupt):
        prepare(some, out, PrepareOptions(threads=1, seed=1), interrupt)
    assert (work / "stale").exists()  # the same input and options: kept


def test_masked_pixels_have_no_features_and_the_mask_is_copied(scene, tmp_path, monkeypatch):
    """Use a video, whose frames are deleted, so that the mask file must be part of the digest."""

    def extract(video, folder, *_):
        (folder / pipeline.DAMAGED).write_text("1 packet is left out")
        for frame in scene[1].glob("pano*.png"):
            shutil.copy(frame, folder)

    monkeypatch.setattr(pipeline, "extract_frames", extract)
    video, hands = tmp_path / "tour.mp4", tmp_path / "hands.png"
    video.write_bytes(b"a film")
    mask = np.full((256, 512), 255, np.uint8)
    mask[160:] = 0
    Image.fromarray(mask).save(hands)
    options = PrepareOptions(threads=2, level=False, mask=str(hands))
    result = prepare(video, tmp_path / "out", options)
    assert {"mask: hands.png for every view", "1 packet is left out"} <= {*result.notes}
    rows = padgs.data.read(tmp_path / "out").tracks().pixels[:, 1]
    assert len(rows) > 300
    assert rows.max() < 161
    assert np.array_equal(np.asarray(Image.open(tmp_path / "out" / "mask.png")), mask)
    assert [*json.loads((tmp_path / "out" / "prepare.json").read_text())["masks"]] == ["mask.png"]
    assert prepare(video, tmp_path / "out", options).points == result.points
    mask[150:] = 0
    Image.fromarray(mask).save(hands)
    with pytest.raises(DataError, match="was not made of"):
        prepare(video, tmp_path / "out", options)


def noise(folder, count=2):
    """Write panoramas of noise to a folder."""
    folder.mkdir(exist_ok=True)
    for index in range(count):
        pixels = np.random.default_rng(index).integers(0, 256, (64, 128, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{index}.png")
    return folder


def test_unrelated_images_are_reported_and_refused_if_there_are_no_others(scene, tmp_path, monkeypatch):
    source, calls = noise(tmp_path / "in"), []
    with monkeypatch.context() as patch:
        patch.setattr(work, "threads_for", lambda *size: calls.append(size) or 1)
        with pytest.raises(DataError, match="no relative pose was found for any two of the 2 panoramas"):
            prepare(source, tmp_path / "out")
    assert not (tmp_path / "out").exists() and calls == [(128, 64)]
    (source / "0.png").unlink()
    for index in range(3):
        shutil.copy(scene[1] / f"pano 00{index}.png", source)
    result = prepare(source, tmp_path / "out", PrepareOptions(threads=2))
    assert result.unregistered == ("1.png",)
    assert any("1 of 4 panoramas have no pose: 1.png" in note for note in result.notes)
    assert not (tmp_path / "out" / "images" / "1.png").exists()


def test_a_result_inside_its_source_is_not_read_as_input(scene, tmp_path):
    """Use panoramas in a format that pycolmap cannot read."""
    for index in range(3):
        path = tmp_path / f"{index}.{'jpg' if index == 2 else 'webp'}"  # a browser may save WebP with another suffix
        Image.open(scene[1] / f"pano 00{index}.png").save(path, "WEBP", lossless=True)
    result = prepare(tmp_path, tmp_path / "flat", PrepareOptions(threads=1))
    assert result.registered == ("0.webp", "1.webp", "2.jpg")
    assert [frame.image.suffix for frame in padgs.data.read(tmp_path / "flat").frames] == [".webp", ".webp", ".jpg"]
    shutil.copy(scene[1] / "pano 000.png", tmp_path / "flat" / "check.png")
    assert prepare(tmp_path, tmp_path / "flat", PrepareOptions(threads=1)) == replace(result, seconds={})


def test_one_destination_is_prepared_by_one_process_at_a_time(tmp_path):
    source, out = noise(tmp_path / "in"), tmp_path / "out"

    def start_another(step, done, total):
        with pytest.raises(DataError, match="another process prepares .*out; wait for it, or choose another path"):
            prepare(source, out)
        assert (tmp_path / ".out.prepare" / "images").is_dir()
        raise KeyboardInterrupt

    for _ in range(2):  # the lock is free after an interruption
        with pytest.raises(KeyboardInterrupt):
            prepare(source, out, PrepareOptions(threads=1), start_another)


def test_errors_of_pycolmap_are_reported_with_a_remedy(tmp_path, monkeypatch):
    def run(tell=lambda step, done, total: None):
        prepare(source, tmp_path / "out", PrepareOptions(threads=1), tell)

    source, database = noise(tmp_path / "in"), tmp_path / ".out.prepare" / "database.db"
    with (
        monkeypatch.context() as patch,
        pytest.raises(
            DataError, match=r"out \(less than \d+ MiB is left on its disk: free some space\); the same command"
        ),
    ):
        run(lambda step, done, total: patch.setattr(work, "MIN_FREE_DISK", 1 << 60))
    found = database.read_bytes()
    database.write_bytes(b"no database" * 1000)
    with pytest.raises(
        DataError,
        match=r"out \(.*\); if its disk is full, .*else remove .*\.out\.prepare to start over",
    ):
        run()
    database.write_bytes(found)

    def fail(*args):
        os.write(2, b"E2026 database.cc:7] SQLite error: disk I/O error\n")
        raise RuntimeError("[database.cc:8] no database")

    monkeypatch.setattr(sfm, "match", fail)
    with pytest.raises(DataError, match=r"out \(no database; SQLite error: disk I/O error\); if its disk is full"):
        run()

    def exhaust(*args):
        raise MemoryError

    monkeypatch.setattr(sfm, "match", exhaust)
    with pytest.raises(DataError, match=r"out \(out of memory\); the same command with --threads 1 uses less"):
        run()


def test_bad_input_is_refused(scene, tmp_path):
    with pytest.raises(ValueError, match="unknown pairs 'some'; known: auto, exhaustive, sequential"):
        PrepareOptions(pairs="some")
    with pytest.raises(ValueError, match="per_second"):
        PrepareOptions(per_second=0.0)
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").touch()
    for source, destination, message in (
        (scene[1], tmp_path / "there", "nothing is overwritten"),
        (tmp_path / "absent", tmp_path / "out", "is not a folder"),
        (tmp_path / "absent.mp4", tmp_path / "out", "cannot be read"),
        (
            scene[1],
            tmp_path / "there" / "file" / "out",
            r"\(Not a directory\); its folder cannot be made: choose another",
        ),
        (scene[1], scene[1] / "images", "images would be read as the images or masks of"),
    ):
        with pytest.raises(DataError, match=message):
            prepare(source, destination)
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_a_destination_that_holds_the_input_is_not_to_be_removed(tmp_path):
    noise(tmp_path / "in")
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").touch()
    for destination, way_out in (
        (tmp_path, "it holds the input: choose another path"),
        (tmp_path / "in", "it holds the input: choose another path"),
        (tmp_path / "there", "remove it or choose another path"),
    ):
        with pytest.raises(DataError, match=f"with these options; nothing is overwritten: {way_out}$"):
            prepare(tmp_path / "in", destination)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "accurate"), [("flat", False), ("garden", False), ("garden", True)])
def test_poses_of_real_panoramas_are_reproduced(shared, tmp_path, name, accurate):
    given = shared / "data" / name
    prepare(given / "images", tmp_path / "out", PrepareOptions(accurate=accurate))  # finds mask.png beside images/
    frames = padgs.data.read(given).frames
    distance, degrees, length = differences(tmp_path / "out", {f.name: f.cam_from_world for f in frames})
    assert len(distance) == len(frames)
    assert distance.max() < 1e-3 * length
    assert degrees.max() < 0.05


@pytest.mark.slow
def test_accurate_mode_finds_exact_poses(scene, tmp_path):
    prepare(scene[1], tmp_path / "out", PrepareOptions(accurate=True))
    reference = {f"pano {view.name}.png": view.cam_from_world for view in scene[0].train}
    distance, degrees, _ = differences(tmp_path / "out", reference)
    assert len(distance) == VIEWS
    assert distance.max() < 4e-3
    assert degrees.max() < 0.08


def test_the_working_folder_is_not_replaced(tmp_path, monkeypatch):
    source = noise(tmp_path / "in")
    (tmp_path / "flat").mkdir()
    monkeypatch.chdir(tmp_path / "flat")
    with pytest.raises(ValueError, match="flat is the working folder or a root, which is not replaced; name a new one"):
        prepare(source, Path.cwd())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flat", "in"]


def test_an_interrupted_first_step_is_not_said_to_continue(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "extract_frames", interrupt)
    (tmp_path / "tour.mp4").write_bytes(b"a film")
    done = CliRunner().invoke(app, ["prepare", str(tmp_path / "tour.mp4"), str(tmp_path / "flat")])
    assert "the same command starts over" in done.stderr and not (tmp_path / ".flat.prepare").exists()
