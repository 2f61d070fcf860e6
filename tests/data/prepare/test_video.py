"""Frames of a video. The decoding itself needs PyAV, an extra."""

import builtins
import errno

import numpy as np
import pytest
from PIL import Image

from padgs.data import DataError
from padgs.data.prepare.sources import extract_frames, is_video, sharpness


def test_videos_are_known_by_name(tmp_path):
    assert is_video(tmp_path / "Tour.MP4")
    assert not is_video(tmp_path / "tour.jpg")


def test_blur_lowers_sharpness():
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (64, 128, 3), np.uint8)
    blurred = ((noise + np.roll(noise, 2, 0) + np.roll(noise, 2, 1).astype(int)) // 3).astype(np.uint8)
    assert sharpness(noise) > 1.3 * sharpness(blurred) > sharpness(np.full_like(noise, 9))


def test_without_the_extra_the_error_says_so(tmp_path, monkeypatch):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.startswith("imageio"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(DataError, match=r"needs imageio and PyAV: pip install 'padgs\[video\]'"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0)


def write(path, frames):
    av = pytest.importorskip("av", reason="PyAV, the extra `video`, is not installed")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height = frames[0].shape[1], frames[0].shape[0]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())


def test_the_sharpest_frame_of_each_interval_is_kept(tmp_path):
    pattern = np.kron(np.indices((16, 32)).sum(0) % 2, np.ones((4, 4)))[..., None] * np.ones(3)
    contrasts = [100 if index in (3, 16) else 20 for index in range(20)]  # two seconds; brightness tells frames apart
    frames = [(40 + 5 * index + contrast * pattern).clip(0, 255) for index, contrast in enumerate(contrasts)]
    path, told = tmp_path / "a b.mp4", []
    write(path, [pixels.astype(np.uint8) for pixels in frames])
    assert extract_frames(path, tmp_path, 1.0, lambda *step: told.append(step)) == 2
    assert told[-1][0] == 20
    for name, index in (("frame_00001.jpg", 3), ("frame_00002.jpg", 16)):
        darkest = np.asarray(Image.open(tmp_path / name)).min()
        assert abs(int(darkest) - (40 + 5 * index)) < 12


def test_what_is_no_panorama_is_refused_at_its_first_frame(tmp_path):
    write(tmp_path / "a.mp4", 3 * [np.zeros((72, 128, 3), np.uint8)])
    told = []
    with pytest.raises(DataError, match=r"a.mp4 is 128x72, which is not 2:1; an equirectangular panorama covers 360"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0, lambda *step: told.append(step))
    assert told == []


def test_not_a_video(tmp_path):
    pytest.importorskip("av", reason="PyAV, the extra `video`, is not installed")
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(DataError, match="cannot be decoded"):
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0)


def test_a_frame_that_cannot_be_written_is_no_fault_of_the_video(tmp_path, monkeypatch):
    write(tmp_path / "a.mp4", 3 * [np.full((64, 128, 3), 90, np.uint8)])

    def refuse(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", refuse)
    with pytest.raises(OSError, match="No space left on device") as refused:
        extract_frames(tmp_path / "a.mp4", tmp_path, 2.0)
    assert refused.value.errno == errno.ENOSPC
