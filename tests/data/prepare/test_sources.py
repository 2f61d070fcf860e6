"""What `prepare` starts from."""

import numpy as np
import pytest
from PIL import Image

from padgs.data import DataError
from padgs.data.assemble import PREPARED, SKIPPED
from padgs.data.prepare.sources import find_source
from padgs.results import CONFIG_NAME, PICTURES


def save(path, value=100, size=(16, 32)):
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = (*size, 3) if path.name != "mask.png" and "masks" not in path.parts else size
    Image.fromarray(np.full(shape, value, np.uint8)).save(path)


def test_images_masks_and_notes(tmp_path):
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
    assert inner.fingerprint == source.fingerprint
    bare = find_source(tmp_path, "none")
    assert bare.masks == {}
    assert bare.fingerprint != source.fingerprint
    assert find_source(tmp_path, "rows:3/4").masks["b.png"]().mean() == pytest.approx(0.75)


def test_masks_and_pictures_of_ours_among_the_images_are_no_images(tmp_path):
    save(tmp_path / "a.png")
    save(tmp_path / "b.png")
    save(tmp_path / "masks" / "a.png", 255)
    for place in (".", "kitchen", "flat/images", "runs/flat/renders"):
        save(tmp_path / place / "check.png")
        save(tmp_path / place / "mask_preview.jpg")
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
    assert source.notes[1:] == (f"not used: kitchen/mask.png; a mask of all panoramas must be in {tmp_path}",)


def test_what_is_left_out_is_said(tmp_path):
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
    with pytest.raises(DataError, match="is not a folder; give a folder of panoramas, or a video"):
        find_source(tmp_path / "nothing", "auto")
    (tmp_path / "VID_1.insv").write_bytes(b"a film")
    with pytest.raises(DataError, match="VID_1.insv is not stitched: export panoramas, or a 2:1 video, with the"):
        find_source(tmp_path / "VID_1.insv", "auto")
    (tmp_path / "VID_1.insv").unlink()
    save(tmp_path / "a.png")
    with pytest.raises(DataError, match="holds 1 images; structure from motion needs at least two$"):
        find_source(tmp_path, "auto")
    (tmp_path / "IMG_1.insp").write_bytes(b"\xff\xd8")
    with pytest.raises(DataError, match="at least two; IMG_1.insp is not stitched: export"):
        find_source(tmp_path, "auto")
    save(tmp_path / "A.png")
    with pytest.raises(DataError, match=r"'A.png' and 'a.png' would share one name"):
        find_source(tmp_path, "auto")
    (tmp_path / "A.png").unlink()
    save(tmp_path / "b.png", size=(16, 31))
    with pytest.raises(DataError, match=r"b.png is 31x16, which is not 2:1"):
        find_source(tmp_path, "auto")
