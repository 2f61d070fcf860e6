"""Frames of videos for `prepare`."""

import errno
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from padgs.data import DataError
from padgs.data.prepare import sources
from padgs.data.prepare.sources import DAMAGED, _pixels, extract_frames, find_source, is_video, sharpness
from padgs.data.prepare.work import PrepareOptions, fingerprint


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


def test_a_video_with_one_frame_is_refused_by_its_name(tmp_path, monkeypatch):
    frames = iter([np.zeros((16, 32, 3), np.uint8)])
    monkeypatch.setattr("padgs.data.prepare.sources._sharpest", lambda *_: frames)
    with pytest.raises(
        DataError, match=r"tour.mp4 gives 1 different frames at 2 a second; .*: take more a second \(`--per-second`"
    ):
        extract_frames(tmp_path / "tour.mp4", tmp_path, 2.0)


def test_videos_are_recognised_by_suffix_and_blur_lowers_sharpness(tmp_path):
    assert is_video(tmp_path / "Tour.MP4") and is_video(tmp_path / "tour.mts") and not is_video(tmp_path / "tour.jpg")
    noise = np.random.default_rng(0).integers(0, 256, (64, 128), np.uint8)
    blurred = ((noise + np.roll(noise, 2, 0) + np.roll(noise, 2, 1).astype(int)) // 3).astype(np.uint8)
    assert sharpness(noise) > 1.3 * sharpness(blurred) > sharpness(np.full_like(noise, 9))


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
