"""Input of `prepare`: folders of panoramas, and videos."""

import errno
import os
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from zlib import crc32

import numpy as np
import pytest
from PIL import Image

from padgs.data import DataError
from padgs.data.assemble import PREPARED, SKIPPED
from padgs.data.prepare import sources
from padgs.data.prepare.sources import DAMAGED, _pixels, extract_frames, find_source, is_video, sharpness
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


def test_a_video_with_one_frame_is_refused_by_its_name(tmp_path, monkeypatch):
    frames = iter([np.zeros((16, 32, 3), np.uint8)])
    monkeypatch.setattr("padgs.data.prepare.sources._sharpest", lambda *_: frames)
    with pytest.raises(
        DataError, match=r"tour.mp4 gives 1 different frames at 2 a second; .*: take more a second \(`--per-second`"
    ):
        extract_frames(tmp_path / "tour.mp4", tmp_path, 2.0)


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


def test_videos_are_recognised_by_suffix_and_blur_lowers_sharpness(tmp_path):
    assert is_video(tmp_path / "Tour.MP4") and is_video(tmp_path / "tour.mts") and not is_video(tmp_path / "tour.jpg")
    noise = np.random.default_rng(0).integers(0, 256, (64, 128), np.uint8)
    blurred = ((noise + np.roll(noise, 2, 0) + np.roll(noise, 2, 1).astype(int)) // 3).astype(np.uint8)
    assert sharpness(noise) > 1.3 * sharpness(blurred) > sharpness(np.full_like(noise, 9))


def test_a_missing_extra_is_reported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(DataError, match=r"needs av, which cannot be imported .*pip install 'padgs\[video\]'"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0)


def write(path, frames, times=None):
    """Write a video of ten frames a second, or of frames at `times` in tenths of a second."""
    av = pytest.importorskip("av", reason="PyAV, the extra `video`, is not installed")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height = frames[0].shape[1], frames[0].shape[0]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        for index, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            frame.pts = index if times is None else times[index]
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize("prefix", ["", "inverted:"])
def test_changed_masks_of_a_video_are_noticed(tmp_path, prefix):
    (tmp_path / "a.mp4").write_bytes(b"a video")
    save(tmp_path / "masks" / "a.png", 255)
    options = PrepareOptions(mask=f"{prefix}{tmp_path / 'masks'}")
    before = fingerprint(tmp_path / "a.mp4", options)
    save(tmp_path / "masks" / "a.png", 0)
    assert fingerprint(tmp_path / "a.mp4", options) != before == before


def test_the_sharpest_frame_of_each_interval_is_kept(tmp_path):
    pattern = np.kron(np.indices((16, 32)).sum(0) % 2, np.ones((4, 4)))[..., None] * np.ones(3)
    contrasts = [100 if index in (3, 16) else 20 for index in range(20)]  # two seconds; brightness tells frames apart
    frames = [(40 + 5 * index + contrast * pattern).clip(0, 255) for index, contrast in enumerate(contrasts)]
    path, calls = tmp_path / "a b.mp4", []
    write(path, [pixels.astype(np.uint8) for pixels in frames])
    assert extract_frames(path, tmp_path, 1.0, lambda *step: calls.append(step)) == 2
    assert calls[-1][0] == 20
    for name, index in (("frame_00001.jpg", 3), ("frame_00002.jpg", 16)):
        darkest = np.asarray(Image.open(tmp_path / name)).min()
        assert abs(int(darkest) - (40 + 5 * index)) < 12


def test_frames_of_damaged_packets_are_left_out(tmp_path):
    write(tmp_path / "a.mp4", [np.full((64, 128, 3), 2 * index, np.uint8) for index in range(100)])
    av = pytest.importorskip("av", reason="PyAV, the extra `video`, is not installed")
    with av.open(str(tmp_path / "a.mp4")) as container:
        places = [(packet.pos, packet.size) for packet in container.demux() if packet.size]
    content = bytearray((tmp_path / "a.mp4").read_bytes())
    for count, (at, size) in enumerate(places[10:14], 1):
        content[at : at + size] = bytes(size)
        (tmp_path / "a.mp4").write_bytes(content)
        if count == 2:
            assert extract_frames(tmp_path / "a.mp4", tmp_path, 1.0) == 10
            note = (tmp_path / DAMAGED).read_text()
            assert re.fullmatch(r"2 of 10[01] packets of .*a.mp4 cannot be decoded, and are left out", note)
    with pytest.raises(DataError, match="4 of 10. packets of .* cannot be decoded, and at most 3% are left out: copy"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 1.0)


def test_equal_frames_of_a_still_are_written_once(tmp_path, monkeypatch):
    still, moved = np.zeros((16, 32, 3), np.uint8), np.full((16, 32, 3), 9, np.uint8)
    monkeypatch.setattr(sources, "_sharpest", lambda *_: iter([still, still, moved, still]))
    assert extract_frames(tmp_path / "a.mp4", tmp_path, 1.0) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame_00001.jpg", "frame_00002.jpg"]


def test_frames_are_chosen_by_time_at_a_variable_rate(tmp_path):
    times = [*range(20), *range(20, 40, 5)]  # two seconds of ten frames a second, then two of two
    write(tmp_path / "a.mp4", [np.full((64, 128, 3), 40 + 5 * time, np.uint8) for time in times], times)
    assert extract_frames(tmp_path / "a.mp4", tmp_path, 2.0) == 8
    brightness = [np.asarray(Image.open(tmp_path / f"frame_0000{n}.jpg")).mean() for n in range(1, 9)]
    assert [int((value - 38) / 25) for value in brightness] == [*range(8)]


@pytest.mark.parametrize(("height", "matrix"), [(576, "ITU601"), (592, "ITU709")])
def test_untagged_videos_have_the_colours_that_players_show(height, matrix):
    av = pytest.importorskip("av", reason="the extra `video` is not installed")
    painted = np.random.default_rng(0).integers(0, 256, (height // 16, height // 8, 3), np.uint8)
    pixels = painted.repeat(16, 0).repeat(16, 1)
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuv420p", dst_colorspace=matrix)
    frame.colorspace = 2
    error = _pixels(frame, Path("a.mp4"))[8::16, 8::16].astype(int) - painted
    assert np.abs(error).max() <= 3
    if hasattr(av.video.reformatter.Interpolation, "ACCURATE_RND"):  # others are darker by 1
        assert np.abs(error.mean((0, 1))).max() < 0.5


@pytest.mark.parametrize(
    ("name", "numbers", "message"),
    [
        ("SPHERICAL", [1], "in another projection than equirectangular"),
        ("STEREO3D", [2], "stereo: export one eye"),
        ("DISPLAYMATRIX", [65536, 0, 0, 0, -65536, 0, 0, 0, 1 << 30], "turned or mirrored"),
        ("DISPLAYMATRIX", [0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30], "turned or mirrored"),
    ],
)
def test_videos_that_are_not_upright_panoramas_of_one_eye_are_refused(name, numbers, message):
    pytest.importorskip("av", reason="the extra `video` is not installed")

    class Side(bytes):
        type = SimpleNamespace(name=name)

    def frame(*numbers, transfer=1):
        side_data = [Side(np.array(numbers, np.int32).tobytes())]
        shared = {"height": 64, "colorspace": 1, "to_ndarray": lambda **_: "pixels"}
        return SimpleNamespace(color_trc=transfer, side_data=side_data, **shared)

    with pytest.raises(DataError, match=f"a.mp4 says that it is {message}"):
        _pixels(frame(*numbers), Path("a.mp4"))
    assert _pixels(frame(*((65536, 0, 0, 0, 65536) if len(numbers) > 1 else (0,))), Path("a.mp4")) == "pixels"
    with pytest.raises(DataError, match=r"a.mp4 is HDR \(transfer PQ\)"):
        _pixels(frame(0, transfer=16), Path("a.mp4"))


def test_other_aspect_ratios_and_other_files_are_refused(tmp_path, monkeypatch):
    write(tmp_path / "a.mp4", 3 * [np.zeros((72, 128, 3), np.uint8)])
    calls = []
    with pytest.raises(DataError, match=r"a.mp4 is 128x72, which is not 2:1; an equirectangular panorama covers 360"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0, lambda *step: calls.append(step))
    assert calls == []  # at the first frame
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(DataError, match="cannot be decoded"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0)
    av = pytest.importorskip("av", reason="the extra video is not installed")

    def of_another_kind(*_):
        raise av.error.PatchWelcomeError(1, "Not yet implemented in FFmpeg")

    monkeypatch.setattr(av, "open", of_another_kind)
    with pytest.raises(DataError, match="cannot be decoded .*Not yet implemented"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0)


def test_write_errors_are_not_reported_as_decoding_errors(tmp_path, monkeypatch):
    write(tmp_path / "a.mp4", 3 * [np.full((64, 128, 3), 90, np.uint8)])

    def refuse(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", refuse)
    with pytest.raises(OSError, match="No space left on device") as refused:
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0)
    assert refused.value.errno == errno.ENOSPC


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


def test_a_missing_mask_of_a_video_is_refused_before_it_is_decoded(tmp_path):
    (tmp_path / "tour.mp4").write_bytes(b"a film")
    with pytest.raises(DataError, match="--mask absent.png: no such file or folder"):
        fingerprint(tmp_path / "tour.mp4", PrepareOptions(mask="absent.png"))


def test_frames_that_are_equal_as_files_are_written_once(tmp_path, monkeypatch):
    still, moved = np.full((16, 32, 3), 100, np.uint8), np.full((16, 32, 3), 9, np.uint8)
    nearly = still.copy()
    nearly[5, 5] = 101  # less than a step of the JPEG
    monkeypatch.setattr(sources, "_sharpest", lambda *_: iter([still, nearly, moved]))
    assert extract_frames(tmp_path / "a.mp4", tmp_path, 1.0) == 2
    assert len(find_source(tmp_path, "auto").images) == 2
