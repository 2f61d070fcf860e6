"""Input of `prepare`: folders of panoramas."""

import os
import shutil
import sys
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from PIL import Image

from padgs.data import DataError
from padgs.data.assemble import PREPARED, SKIPPED
from padgs.data.prepare.sources import extract_frames, find_source
from padgs.data.prepare.work import PrepareOptions, fingerprint
from padgs.results import CONFIG_NAME, PICTURES


def save(path, value=100, size=(16, 32)):
    path.parent.mkdir(parents=True, exist_ok=True)
    is_mask = path.name.lower() == "mask.png" or "masks" in path.parts
    pixels = np.full(size if is_mask else (*size, 3), value, np.uint8)
    if not is_mask:
        pixels.reshape(-1)[:4] = np.frombuffer(
            crc32(str(path).encode()).to_bytes(4, "big"), np.uint8
        )  # none is another
    Image.fromarray(pixels).save(path)


def test_images_masks_and_notes(tmp_path, monkeypatch):
    for name in ("b.png", "a.png", "up stairs/ç.png"):
        save(tmp_path / "images" / name)
    mask = np.full((16, 32), 255, np.uint8)
    mask[12:] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    source = find_source(tmp_path, "auto")
    assert list(source.images) == ["a.png", "b.png", "up stairs/ç.png"]
    assert source.notes == ("mask: mask.png for every view",)
    assert source.masks["a.png"]().mean() == pytest.approx(0.75)
    inner = find_source(tmp_path / "images", "auto")  # the same, asked for by the image folder
    monkeypatch.chdir(tmp_path / "images")
    assert find_source(Path(), "auto").masks.keys() == inner.masks.keys() != set(), "from within"
    assert inner.fingerprint == source.fingerprint
    bare = find_source(tmp_path, "none")
    assert bare.masks == {}
    assert bare.fingerprint != source.fingerprint
    assert find_source(tmp_path, "rows:3/4").masks["b.png"]().mean() == pytest.approx(0.75)


def test_masks_overlays_and_renders_are_not_panoramas(tmp_path):
    save(tmp_path / "a.png")
    save(tmp_path / "b.png")
    save(tmp_path / "masks" / "a.png", 255)
    for place in (".", "kitchen", "flat/images", "runs/flat/renders"):
        save(tmp_path / place / "check.png")
    (tmp_path / "flat" / PREPARED).touch()
    assert SKIPPED[1] == (CONFIG_NAME, PICTURES)
    (tmp_path / "runs" / "flat" / CONFIG_NAME).touch()
    for place in ("flat/images", "runs/flat/renders"):
        save(tmp_path / place / "a.png")
    source = find_source(tmp_path, "auto")
    assert list(source.images) == ["a.png", "b.png"]
    assert list(source.masks) == ["a.png"]
    assert source.notes == ("masks: masks/ for 1 of 2 views",)
    save(tmp_path / "kitchen" / "mask.png", 255)
    source = find_source(tmp_path, "auto")
    assert list(source.images) == ["a.png", "b.png"]
    rule = f"a mask of all panoramas must be in {tmp_path}, others in masks/ with their names"
    assert source.notes[1:] == (f"not used: kitchen/mask.png; {rule}",)


def half(path):
    """Save a mask that hides the lower half."""
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.repeat(np.uint8([255, 0]), 8 * 32).reshape(16, 32)).save(path)


@pytest.mark.parametrize("inverted", ["", "inverted:"])
@pytest.mark.parametrize(("file", "spec"), [("hands.png", "hands.png"), ("hide/a.png", "hide"), ("hide/b.png", "@")])
def test_masks_that_an_option_names_are_no_panoramas(inverted, file, spec, tmp_path):
    for name in ("a.png", "b.png"):
        save(tmp_path / name)
    half(tmp_path / file)
    source = find_source(tmp_path, inverted + spec.replace("@", str(tmp_path / "hide")))
    assert list(source.images) == ["a.png", "b.png"]
    assert list(source.masks) == (["a.png", "b.png"] if file == "hands.png" else [Path(file).name])
    assert [mask().mean(1).tolist() for mask in source.masks.values()] == len(source.masks) * [
        8 * [0.0] + 8 * [1.0] if inverted else 8 * [1.0] + 8 * [0.0]
    ]


def test_only_what_an_option_names_is_no_panorama(tmp_path):
    for name in ("None/a.png", "None/b.png", "none/c.png"):
        save(tmp_path / name)
    for spec in ("auto", "none", "rows:3/4"):
        assert list(find_source(tmp_path, spec).images) == ["None/a.png", "None/b.png", "none/c.png"]
    half(tmp_path / "None" / "a_mask.png")
    beside = find_source(tmp_path / "None", str(tmp_path / "None"))
    assert (list(beside.images), list(beside.masks)) == (["a.png", "b.png"], ["a.png"]), "the folder of the panoramas"


@pytest.mark.parametrize("name", ["images", "imgs", "RGB"])
def test_masks_beside_a_folder_of_images_are_those_of_its_images(tmp_path, name):
    for file in (f"{name}/a.png", f"{name}/b.png"):
        save(tmp_path / file)
    half(tmp_path / "masks" / "a.png")
    assert list(find_source(tmp_path / name, "auto").masks) == ["a.png"]


def test_a_mask_of_all_panoramas_may_lie_among_them(tmp_path):
    for name in ("images/a.png", "images/b.png"):
        save(tmp_path / name)
    half(tmp_path / "images" / "mask.png")
    for place in (tmp_path, tmp_path / "images"):
        source = find_source(place, "auto")
        assert source.notes == ("mask: mask.png for every view",)
        assert {name: mask().mean().item() for name, mask in source.masks.items()} == {"a.png": 0.5, "b.png": 0.5}
        assert find_source(place, "inverted").masks["a.png"]()[8:].all()
    half(tmp_path / "hands.png")
    assert find_source(tmp_path, "hands.png").notes[0] == "mask: hands.png for every view"
    (tmp_path / "hands.png").unlink()
    half(tmp_path / "masks" / "a.png")
    source = find_source(tmp_path, "auto")
    assert list(source.masks) == ["a.png"] and source.notes[1].startswith(
        "not used: mask.png; a mask of all panoramas must"
    )


@pytest.mark.parametrize(
    "mask", ["masks/hall/a.png", "hall/masks/a.png", "hall/masks/a.png.png", "hall/mask_a.png", "hall/a-mask.png"]
)
@pytest.mark.parametrize("top", ["", "images"])
def test_masks_of_panoramas_in_folders(mask, top, tmp_path):
    folder = tmp_path / top
    for name in ("hall/a.png", "hall/b.png", "attic/a.png"):
        save(folder / name)
    (folder / mask).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.repeat(np.uint8([0, 255]), 16 * 16).reshape(16, 32)).save(folder / mask)
    source = find_source(tmp_path, "auto")
    assert list(source.images) == ["attic/a.png", "hall/a.png", "hall/b.png"]
    assert list(source.masks) == ["hall/a.png"]
    assert source.masks["hall/a.png"]().mean(dim=1).tolist() == [0.0] * 8 + [1.0] * 8


def test_masks_that_belong_to_no_panorama_are_noted(tmp_path):
    for name in ("hall/a.png", "hall/b.png", "hall/Sky Masks/1.png", "hall/masks/c.png"):
        save(tmp_path / name)
    source = find_source(tmp_path, "auto")
    assert list(source.images) == ["hall/a.png", "hall/b.png"] and not source.masks
    assert source.notes[-1].startswith("not used: hall/Sky Masks/1.png, hall/masks/c.png; a mask of all panoramas must")


def test_the_named_folder_is_taken_if_it_holds_panoramas_itself(tmp_path):
    for name in ("a.png", "b.png", "rgb/c.png", "images/d.png"):
        save(tmp_path / name)
    assert list(find_source(tmp_path, "auto").images) == ["a.png", "b.png", "images/d.png", "rgb/c.png"]


def test_links_and_names_in_any_case_are_followed(tmp_path):
    for name in ("there/b.png", "there/a.png", "there/@eaDir/a.png/THUMB.png", "Mask.PNG"):
        save(tmp_path / name, 255)
    (tmp_path / "flat").mkdir()
    (tmp_path / "flat" / "room").symlink_to(tmp_path / "there")
    (tmp_path / "there" / "back").symlink_to(tmp_path / "flat")
    source = find_source(tmp_path / "flat", "auto")
    assert list(source.images) == ["room/a.png", "room/b.png"]
    (tmp_path / "flat").rename(tmp_path / "Images")
    assert find_source(tmp_path, "auto").notes[0] == "mask: Mask.PNG for every view"
    (tmp_path / "there" / "a.png").rename(tmp_path / "there" / os.fsdecode(b"k\xfcche.png"))
    with pytest.raises(DataError, match="room/k.*che.png', which is not Unicode; rename the file"):
        find_source(tmp_path, "auto")


def test_ignored_files_are_reported(tmp_path):
    for name in ("1.insp", "2.INSP", "3.insp", "a.heic", "notes"):
        (tmp_path / name).touch()
    with pytest.raises(
        DataError,
        match=r"holds 0 images \(left out: 3 .insp, 1 .heic, 1 without a suffix\); structure from motion needs at "
        "least two; 1.insp is not stitched: export .*; a.heic is .*: convert all such images to JPEG$",
    ):
        find_source(tmp_path, "auto")
    for name in ("1.insp", "2.INSP", "3.insp", "a.heic"):
        (tmp_path / name).unlink()
    save(tmp_path / "a.png")
    save(tmp_path / "b.png")
    (tmp_path / "tour.MP4").touch()
    assert find_source(tmp_path, "auto").notes == (
        "left out: 1 without a suffix, 1 .mp4; tour.MP4 is a video: give its own path, not that of its folder",
    )


def test_bad_input_is_refused(tmp_path):
    def refused(message, path=tmp_path):
        with pytest.raises(DataError, match=message):
            find_source(path, "auto")

    refused("is not a folder; give a folder of panoramas, or a video", tmp_path / "nothing")
    for name in ("VID_1.insv", "CAM_1.OSV"):
        (tmp_path / name).write_bytes(b"a film")
        for path in (tmp_path / name, tmp_path):
            refused(f"{name} is not stitched: export panoramas, or a 2:1 video, with the", path)
        (tmp_path / name).unlink()
    save(tmp_path / "a.png")
    refused("holds 1 images; structure from motion needs at least two$")
    (tmp_path / "IMG_1.insp").write_bytes(b"\xff\xd8")
    refused("at least two; IMG_1.insp is not stitched: export")
    save(tmp_path / "A.png")
    refused(r"'A.png' and 'a.png' would share one name")
    (tmp_path / "A.png").unlink()
    save(tmp_path / "b.png", size=(16, 31))
    refused(r"b.png is 31x16, which is not 2:1")
    save(tmp_path / "c.png", size=(30, 40))
    save(tmp_path / "d.png", size=(64, 36))
    (tmp_path / "e.png").touch()
    (tmp_path / "f.png").touch()
    photograph = r"which is not 2:1; .* \(it has the shape of an ordinary photograph: move it elsewhere\)"
    refused(rf"b.png is 31x16, .*c.png is 40x30, {photograph}, .*d.png is 36x64, {photograph} and 2 more$")


def test_a_missing_extra_is_reported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(DataError, match=r"needs av, which cannot be imported .*pip install 'padgs\[video\]'"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0)


@pytest.mark.parametrize("prefix", ["", "inverted:"])
def test_changed_masks_of_a_video_are_noticed(tmp_path, prefix):
    (tmp_path / "a.mp4").write_bytes(b"a video")
    save(tmp_path / "masks" / "a.png", 255)
    options = PrepareOptions(mask=f"{prefix}{tmp_path / 'masks'}")
    before = fingerprint(tmp_path / "a.mp4", options)
    save(tmp_path / "masks" / "a.png", 0)
    assert fingerprint(tmp_path / "a.mp4", options) != before == before


def test_two_equal_images_are_refused_before_any_work(tmp_path):
    for name in ("a.png", "b.png"):
        save(tmp_path / name)
    shutil.copy(tmp_path / "a.png", tmp_path / "a (1).png")
    with pytest.raises(DataError, match=r"images that are the same: a.*; remove one of each pair"):
        find_source(tmp_path, "auto")


def test_images_beside_the_folder_of_images_are_named(tmp_path):
    for name in ("images/a.png", "images/b.png", "images_2/a.png"):
        save(tmp_path / name)
    found = find_source(tmp_path, "auto")
    assert list(found.images) == ["a.png", "b.png"]
    assert "1 images beside images/ are not used: images_2/a.png" in found.notes
