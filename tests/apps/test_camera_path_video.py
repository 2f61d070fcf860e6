"""Camera-path videos: encoding, spherical metadata, and `padgs render`."""

import json
import shutil
import struct
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from support.tiny_run import tiny_run
from typer.testing import CliRunner

from padgs.apps.camera_path_video import views_along, write_video
from padgs.cli.commands import app
from padgs.data.depths import read_depth
from padgs.runs.load import load_run
from padgs.scene import View

try:
    import av
    import imageio.plugins.pyav
    import imageio.v3 as imageio
except ImportError:
    imageio = None
WITH_VIDEO = pytest.mark.skipif(imageio is None, reason="the extra `video` is not installed")
COLOURS = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0]])
SHOWN = SimpleNamespace(image=COLOURS.repeat_interleave(16, 0).expand(32, 64, 3))  # a column of each
BAD_NUMBERS, BAD_SIDES = ("inf", "nan", "-1", "0", "1e30"), ("-1", "1000000000")
VIEW = View("a", torch.eye(4, dtype=torch.float64), 64, 32)


@WITH_VIDEO
def test_videos_state_their_color_space(tmp_path):
    write_video(tmp_path / "a.mp4", [VIEW], lambda view: SHOWN, fps=10, scene_scale=1)
    with av.open(str(tmp_path / "a.mp4")) as video:
        stream = video.streams.video[0]
        assert (stream.colorspace, stream.color_primaries, stream.color_trc) == (1, 1, 1), "all BT.709"
        picture = next(video.decode(stream)).to_ndarray(format="rgb24", src_colorspace="ITU709")
    assert np.abs(picture[16, 8::16] - 255 * COLOURS.numpy()).max() < 6


@WITH_VIDEO
def test_an_interrupted_video_keeps_the_earlier_one(tmp_path):
    def stop(done):
        if done == 99:  # when the encoder, which looks ahead, has written some
            raise KeyboardInterrupt

    (tmp_path / "a.mp4").write_text("the earlier one")
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", 100 * [VIEW], lambda view: SHOWN, fps=10, scene_scale=1, progress=stop)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["the earlier one"]


def test_interrupted_images_do_not_block_the_next_call(tmp_path):
    def stop(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "frames", 2 * [VIEW], lambda view: SHOWN, fps=10, scene_scale=1, progress=stop)
    write_video(tmp_path / "frames", 2 * [VIEW], lambda view: SHOWN, fps=10, scene_scale=1)
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["00001.png", "00002.png"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tiny_run(tmp_path_factory)  # omnigs, whose projection erp draws whole panoramas only


def render(*arguments: str):
    return CliRunner().invoke(app, ["render", *arguments])


def boxes(data: bytes) -> list[tuple[bytes, bytes]]:
    """Return type and content of consecutive boxes."""
    found, at = [], 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        found.append((kind, data[at + 8 : at + size]))
        at += size
    assert at == len(data), "sizes add up"
    return found


@WITH_VIDEO
def test_a_panoramic_video_plays_and_has_spherical_metadata(folder, tmp_path):
    result = render(str(folder), "--to", str(tmp_path / "new" / "a.mp4"), "--seconds", "0.5", "--fps", "10", "--depth")
    assert result.exit_code == 0 and "5 frames of 32x16" in result.output, result.output
    for name in ("a.mp4", "a-depth.mp4"):
        frames = imageio.imread(tmp_path / "new" / name, plugin="pyav")
        assert frames.shape == (5, 16, 32, 3) and frames.std() > 5
        index = dict(boxes((tmp_path / "new" / name).read_bytes()))[b"moov"]
        (mark,) = [content for kind, content in boxes(dict(boxes(index))[b"trak"]) if kind == b"uuid"]
        assert mark[:16].hex() == "ffcc8263f8554a938814587a02521fdd"
        assert b"<GSpherical:ProjectionType>equirectangular<" in mark


@WITH_VIDEO
def test_a_perspective_video_has_no_spherical_metadata(folder, tmp_path):
    arguments = ("--camera", "perspective", "--width", "32", "--seconds", "0.2", "--fps", "10", "--path", "orbit")
    assert render(str(folder), *arguments, "--to", str(tmp_path / "a.mp4")).exit_code == 0
    assert b"GSpherical" not in (tmp_path / "a.mp4").read_bytes()
    assert render(str(folder), *arguments, "--height", "17", "--to", str(tmp_path / "b.mp4")).exit_code == 1


def test_a_perspective_render_agrees_with_the_panorama(folder, tmp_path):
    """Compare the centres of both, which look along the same axis."""
    same = ("--path", "dolly", "--seconds", "0.1", "--fps", "20", "--depth")
    assert render(str(folder), *same, "--to", str(tmp_path / "p")).exit_code == 0
    focal_of_panorama = 32 / (2 * np.pi)
    fov = 2 * np.degrees(np.arctan(4 / focal_of_panorama))
    assert (
        render(
            *(str(folder), *same, "--to", str(tmp_path / "q"), "--camera", "perspective", "--fov", str(fov)),
            *("--width", "8", "--height", "4"),
        ).exit_code
        == 0
    )
    panorama, perspective = (np.array(Image.open(tmp_path / name / "00001.png"), float) for name in ("p", "q"))
    assert np.abs(panorama[7:9, 15:17].mean((0, 1)) - perspective[1:3, 3:5].mean((0, 1))).max() < 12
    depth = np.array(Image.open(tmp_path / "q-depth" / "00001.png"))
    assert depth.dtype == np.uint16 and depth.min() > 0
    unit = load_run(folder).scene.scale / 1000
    assert f"one step is {unit:.6g} world units" in Image.open(tmp_path / "q-depth" / "00001.png").text["Description"]
    frame = json.loads((tmp_path / "q-depth" / "depth.json").read_text())["frames"]["00001"]
    assert frame["camera"] | {"fx": 0, "fy": 0} == dict(model="pinhole", width=8, height=4, fx=0, fy=0, cx=4, cy=2)
    pose = views_along(load_run(folder), "dolly", 0.1, 20)[0].cam_from_world
    np.testing.assert_allclose(frame["cam_from_world"], pose.numpy(), atol=1e-6)


def test_written_depths_can_be_read_as_depth_maps(tmp_path):
    depth = 5 * torch.rand(32, 64)
    shown = SimpleNamespace(image=SHOWN.image, depth=depth)
    origin, options = torch.tensor([10.0, 0.0, 0.0]), {"fps": 10, "scene_scale": 2.5, "depth": True}
    (tmp_path / "a.1").mkdir()  # a dot in the name of a folder begins no suffix
    write_video(tmp_path / "a.1", [VIEW], lambda view: shown, origin=origin, **options)
    stated = json.loads((tmp_path / "a.1-depth" / "depth.json").read_text())
    assert stated["measure"] == "ray" and stated["unit"] == 0.0025
    assert np.linalg.inv(stated["frames"]["00001"]["cam_from_world"])[:3, 3].tolist() == [10, 0, 0]
    found = read_depth(next((tmp_path / "a.1-depth").glob("00001.*"))) * stated["unit"]
    np.testing.assert_allclose(found, depth, atol=0.00126)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--camera", "fisheye"), "unknown camera 'fisheye'; known: panorama, perspective"),
        *((("--fps", value), f"--fps is {float(value)}; it must be from 0.01 to 1000") for value in BAD_NUMBERS),
        *((("--seconds", value), f"--seconds is {float(value):g}, which makes") for value in BAD_NUMBERS),
        *((("--width", value), f"--width is {value}; it must be from 2 to 16384") for value in BAD_SIDES),
        (("--width", "31"), "--width is 31; a panorama is 2:1, so it must be even"),
        *(
            (("--camera", "perspective", "--height", value), f"--height is {value}; it must be from 1 to 16384")
            for value in ("0", *BAD_SIDES)
        ),
        (("--height", "9"), "belong to perspective images: add --camera perspective"),
        (("--path", "spiral"), "the path spiral does not exist; known: cameras, orbit, dolly"),
        *(
            (("--camera", "perspective", "--fov", value), f"--fov is {float(value)}; it must be from 0.1 to 179.9")
            for value in ("180", "1e-300", *BAD_NUMBERS)
        ),
    ],
)
def test_invalid_options_are_refused(arguments, message, folder, tmp_path):
    result = render(str(folder), *arguments, "--to", str(tmp_path / "frames"))
    assert result.exit_code == 1 and message in " ".join((result.output + result.stderr).split())


@WITH_VIDEO
def test_a_video_without_a_name_replaces_none(folder, tmp_path):
    run = shutil.copytree(folder, tmp_path / "run")
    (run / "video.mp4").write_text("of the camera")
    for number in (2, 3):
        done = render(str(run), "--seconds", "0.1", "--fps", "20")
        assert done.exit_code == 0 and f"video-{number}.mp4: 2 frames" in " ".join(done.output.split()), done.output
    assert (run / "video.mp4").read_text() == "of the camera"


def test_a_folder_with_images_is_refused(folder, tmp_path):
    arguments = (str(folder), "--to", str(tmp_path / "f"), "--seconds", "0.1", "--fps", "20")
    assert render(*arguments).exit_code == 0
    assert "already holds images" in render(*arguments).stderr
    result = render(*arguments, "--to", str(tmp_path / ".mp4"))
    assert result.exit_code == 1 and ".mp4 has no name before its suffix; name the video" in result.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"f"}


def test_errors_name_the_option_for_output_and_data(folder, tmp_path):
    (tmp_path / "file").touch()
    result = render(str(folder), "--to", str(tmp_path / "file"), "--seconds", "0.1", "--fps", "20")
    assert result.exit_code == 1 and f"cannot write {tmp_path}/file: " in result.stderr and "with --to" in result.stderr
    (tmp_path / "a.mp4").mkdir()
    result = render(str(folder), "--to", str(tmp_path / "a.mp4"), "--seconds", "0.1", "--fps", "20")
    assert result.exit_code == 1 and "a.mp4: Is a directory; name another place with --to" in result.stderr
    result = render(str(folder), "--path", "/dev/zero", "--to", str(tmp_path / "f"))
    assert result.exit_code == 1 and "/dev/zero" in result.stderr and "--data" not in result.stderr
    result = render(str(folder), "--data", str(tmp_path / "gone"), "--to", str(tmp_path / "f"))
    assert result.exit_code == 1 and f"it is the data of {folder}: if it has moved" in result.stderr


def test_other_video_formats_are_refused(folder, tmp_path):
    result = render(str(folder), "--to", str(tmp_path / "x.avi"))
    assert result.exit_code == 1 and "x.avi is not an .mp4" in " ".join(result.output.split())
    assert not list(tmp_path.iterdir())
