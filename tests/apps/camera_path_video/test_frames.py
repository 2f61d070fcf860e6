"""Films: the colours that players show, and nothing half-written."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from padgs.apps.camera_path_video import write_video
from padgs.scene import View

av = pytest.importorskip("av", reason="PyAV, the extra `video`, is not installed")
COLOURS = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0]])
SHOWN = SimpleNamespace(image=COLOURS.repeat_interleave(16, 0).expand(32, 64, 3))  # a column of each
VIEW = View("a", torch.eye(4, dtype=torch.float64), 64, 32)


def test_players_are_told_the_colours_that_a_film_has(tmp_path):
    write_video(tmp_path / "a.mp4", [VIEW], lambda view: SHOWN, fps=10, scene_scale=1)
    with av.open(str(tmp_path / "a.mp4")) as film:
        stream = film.streams.video[0]
        assert (stream.colorspace, stream.color_primaries, stream.color_trc) == (1, 1, 1), "all BT.709"
        picture = next(film.decode(stream)).to_ndarray(format="rgb24", src_colorspace="ITU709")
    assert np.abs(picture[16, 8::16] - 255 * COLOURS.numpy()).max() < 6


def test_a_film_that_is_cut_off_leaves_the_earlier_one(tmp_path):
    def stop(done):
        if done == 99:  # when the encoder, which looks ahead, has written some
            raise KeyboardInterrupt

    (tmp_path / "a.mp4").write_text("the earlier one")
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", 100 * [VIEW], lambda view: SHOWN, fps=10, scene_scale=1, progress=stop)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["the earlier one"]


def test_pictures_that_are_cut_off_do_not_bar_the_next(tmp_path):
    def stop(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "frames", 2 * [VIEW], lambda view: SHOWN, fps=10, scene_scale=1, progress=stop)
    write_video(tmp_path / "frames", 2 * [VIEW], lambda view: SHOWN, fps=10, scene_scale=1)
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["00001.png", "00002.png"]
