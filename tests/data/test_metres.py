"""Worlds in metres, against cameras, points and GPS of known scale."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from support.fixtures import World, write_colmap_text
from typer.testing import CliRunner

import padgs.data
from padgs.cli.commands import app
from padgs.data import DataError
from padgs.data.camera_paths import centers
from padgs.data.capture import Cloud, Frame
from padgs.data.metres import KnownLength, gps_of, local_metres, moved, named, to_metres, unit_note
from padgs.data.synthetic.paths import cam_from_world

SCALE = 0.37  # world units per metre
DEGREES = 1 / 111_195  # of latitude, per metre on a sphere of the Earth's radius


def cameras(count: int = 12, height: float = 1.6, turn: float = 0.0) -> list[Frame]:
    """Return cameras at `height` on a bent path of some 20 m, in a world of another unit, turned about +z."""
    frames = []
    for k in range(count):
        c, s, x, y = math.cos(turn), math.sin(turn), 2.0 * k, 4 * math.sin(k / 2)
        place = SCALE * np.array((c * x - s * y, s * x + c * y, height + 0.02 * math.sin(k)))
        frames.append(Frame(f"{k:02d}.jpg", Path(f"{k:02d}.jpg"), torch.from_numpy(cam_from_world(place, 0.3 * k))))
    return frames


def room(floor: bool = True, table: bool = True) -> Cloud:
    """Return points of walls, and of a floor at z = 0 and a table at 0.75 m."""
    random = np.random.default_rng(0)
    walls = random.uniform((-3, 8, 0.3), (25, 8.1, 3), (2000, 3))
    parts = [walls]
    if floor:
        parts.append(
            random.normal((0, 0, 0), (0, 0, 0.005), (800, 3)) + random.uniform((-3, -8, 0), (25, 8, 0), (800, 3))
        )
    if table:
        parts.append(random.uniform((4, 5, 0.74), (6, 7, 0.76), (300, 3)))
    return Cloud(torch.from_numpy(SCALE * np.concatenate(parts)), None)


def scale_of(frames: tuple[Frame, ...], known: KnownLength, cloud: Cloud | None = None) -> float:
    change, note = to_metres(frames, cloud, known)
    there, points = moved(frames, cloud, change)
    before, after = (centers(torch.stack([frame.cam_from_world for frame in some])) for some in (frames, there))
    factor = (after[5] - after[0]).norm() / (before[5] - before[0]).norm()
    if cloud is not None:
        torch.testing.assert_close(torch.cdist(after, points.points), factor * torch.cdist(before, cloud.points))
    assert note.startswith("lengths are in metres, by ")
    return factor.item()


def test_two_cameras_at_a_known_distance():
    frames = cameras()
    metres = math.hypot(20, 4 * math.sin(5), 0.02 * math.sin(10))
    assert scale_of(frames, KnownLength(("00.png", "10", metres)), room()) == pytest.approx(1 / SCALE)


def test_names_are_found_in_any_case_and_unicode_form():
    assert named(["Ku\u0308che.JPG", "b\u00e4d/1.png", "2.png"], "k\u00fcche.jpg", "K\u00dcCHE", "Ba\u0308d/1") == [
        0,
        0,
        1,
    ]
    frames = [replace(frame, name=f"Fl\u00fcr {frame.name}") for frame in cameras()]
    metres = math.hypot(20, 4 * math.sin(5), 0.02 * math.sin(10))
    known = KnownLength(("flu\u0308r 00.JPG", "FL\u00dcR 10", metres))
    assert scale_of(frames, known, room()) == pytest.approx(1 / SCALE)
    with pytest.raises(DataError, match="no panorama with a pose is called 'flur 00'; known: Flür 00.jpg"):
        named([frame.name for frame in frames], "flur 00")


def test_cameras_at_a_known_height_above_the_floor():
    known = KnownLength(camera_height=1.6)
    assert scale_of(cameras(), known, room()) == pytest.approx(1 / SCALE, rel=0.01)
    uneven = [*cameras(6), *cameras(height=2.6)[6:]]
    for frames, cloud, message in (
        (cameras(), None, "there are no points"),
        (cameras(), room(floor=False, table=False), "no floor was found: "),
        (cameras()[:2], Cloud(torch.zeros(9, 3), None), "no floor was found: of the 9 points below"),
        (cameras(), room(floor=False), "no floor was found: .* may be a table"),
        (uneven, room(), "heights differ by"),
    ):
        with pytest.raises(DataError, match=f"--camera-height: .*{message}.*use --metres A B DISTANCE"):
            to_metres(frames, cloud, known)


def with_gps(frames, folder, noise=0.0, share=1.0, spread=1.0):
    """Write images with the GPS of cameras whose y axis looks 30 degrees east of north."""
    random, written = np.random.default_rng(1), []
    for k, frame in enumerate(frames):
        x, y, z = (centers(frame.cam_from_world[None])[0] / SCALE).tolist()
        c, s = math.cos(math.radians(-30)), math.sin(math.radians(-30))
        east, north = (spread * np.array((c * x - s * y, s * x + c * y)) + noise * random.standard_normal(2)).tolist()
        exif = Image.Exif()
        if k < share * len(frames):
            latitude, longitude = -33.5 + north * 180 / math.pi / 6_358_900, 151.2 + east * 180 / math.pi / 5_327_350
            places = ("S", _sexagesimal(-latitude), "E", _sexagesimal(longitude), b"\0", 40.0 + z)
            exif.get_ifd(0x8825).update(dict(enumerate(places, 1)))
        path = folder / frame.name
        Image.new("RGB", (32, 16), (k, 90, 90)).save(path, exif=exif)
        written.append(Frame(frame.name, path, frame.cam_from_world))
    return written


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    minutes = 60 * (degrees % 1)
    return float(int(degrees)), float(int(minutes)), 60 * (minutes % 1)


def test_gps_turns_the_world_to_east_and_north(tmp_path):
    frames = with_gps(cameras(), tmp_path)
    assert gps_of(frames[0].image) == pytest.approx((-33.5, 151.2, 41.6), abs=1e-5)
    change, note = to_metres(frames, None, KnownLength(gps=True))
    assert "x is east, y north, z up from latitude, longitude, altitude -33.5" in note
    _, truth = local_metres([gps_of(frame.image) for frame in frames])
    found = centers(torch.stack([frame.cam_from_world for frame in moved(frames, None, change)[0]]))
    torch.testing.assert_close(found, truth, atol=0.02, rtol=0)
    length = (found[11] - found[0]).norm().item()
    assert length == pytest.approx(math.dist((0, 0), (22, 4 * math.sin(5.5))), rel=1e-3)
    noisy = with_gps(cameras(), tmp_path, noise=0.5)
    assert scale_of(noisy, KnownLength(gps=True)) == pytest.approx(1 / SCALE, rel=0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"share": 0.15}, "2 of 12 images have a GPS position, 2 different ones, and at least 3"),
        ({"spread": 0.1}, "the positions spread by .* m, and at least 3 m"),
        ({"noise": 4.0}, r"from their GPS positions \(root mean square\), more than 15%"),
    ],
)
def test_gps_that_does_not_give_the_scale_is_refused(changes, message, tmp_path):
    with pytest.raises(DataError, match=f"--gps: .*{message}.*use --metres A B DISTANCE or --camera-height"):
        to_metres(with_gps(cameras(), tmp_path, **changes), None, KnownLength(gps=True))


def test_gps_without_altitude_is_a_position(tmp_path):
    exif = Image.Exif()
    place = ("N", (48.0, 30.0, 0.0), "W", (9.0, 15.0, 0.0), b"\0", IFDRational(0, 0))
    exif.get_ifd(0x8825).update(dict(enumerate(place, 1)))
    Image.new("RGB", (32, 16)).save(tmp_path / "a.jpg", exif=exif)
    assert gps_of(tmp_path / "a.jpg") == (48.5, -9.25, 0.0)


def test_local_metres_agree_with_the_ellipsoid():
    """A degree of latitude at the equator has 110 574 m, one of longitude 111 320 m."""
    (_, (east, north)) = None, local_metres([(-0.5, 10.0, 0.0), (0.5, 10.0, 0.0)])[1][:, :2].T
    assert (north[1] - north[0]).item() == pytest.approx(110_574, abs=2) and east.abs().max() < 1e-6
    places = local_metres([(0.0, 9.995, 5.0), (0.0, 10.005, 5.0)])[1]
    assert (places[1, 0] - places[0, 0]).item() == pytest.approx(1113.20, abs=0.01)


@pytest.mark.parametrize("first", [179.9999, -179.9999])
def test_the_180th_meridian_is_no_gap(first: float):
    (_, longitude, _), places = local_metres([(0.0, first, 0.0), (0.0, -first, 0.0), (0.0, 179.9999, 0.0)])
    east = places[:, 0] * (1 if first > 0 else -1)
    assert (east[1] - east[0]).item() == pytest.approx(22.264, abs=0.001)
    assert 179.9999 < longitude < 180


def test_convert_writes_metres_and_says_so(world: World, tmp_path: Path):
    def run(*arguments: object):
        return CliRunner().invoke(app, ["convert", str(tmp_path / "a"), str(tmp_path / "b"), *map(str, arguments)])

    write_colmap_text(world, tmp_path / "a")
    first, *_, last = padgs.data.read(tmp_path / "a").frames
    (tmp_path / "a/depths").mkdir()
    (tmp_path / "a/depths/depth.json").write_text('{"measure": "ray", "unit": 0.5}')
    np.save(tmp_path / f"a/depths/{Path(first.name).stem}.npy", np.full((16, 32), 3.0))
    length = (centers(first.cam_from_world[None]) - centers(last.cam_from_world[None])).norm().item()
    refused = (
        (("--metres", first.name, "nobody", 3), "no panorama with a pose is called 'nobody'; known: "),
        (("--metres", first.name, first.name, 3), "were taken at one place"),
        (("--metres", first.name, last.name, 0), "the distance of --metres is 0; it must be"),
        (("--camera-height", "nan"), "--camera-height is nan"),
        (("--gps", "--camera-height", 2), "give one of --metres, --camera-height and --gps"),
        (("--gps",), "0 of 6 images have a GPS position"),
    )
    for arguments, message in refused:
        done = run("--to", "nerfstudio", *arguments)
        assert done.exit_code == 1 and message in " ".join(done.output.split()), done.output
        assert not (tmp_path / "b").exists()
    done = run("--to", "nerfstudio", "--metres", first.name, last.name, 7.5)
    text = " ".join(done.output.split())
    assert done.exit_code == 0 and "lengths are in metres, by 7.5 m between" in text, text
    there, *_, here = padgs.data.read(tmp_path / "b").frames
    metres = (centers(there.cam_from_world[None]) - centers(here.cam_from_world[None])).norm().item()
    assert metres == pytest.approx(7.5)
    scene = padgs.data.load(tmp_path / "b", split="all")
    assert unit_note(tmp_path / "b")[0] in scene.notes
    depth = next(view for view in scene.train if view.name == Path(first.name).stem).load_depth()
    torch.testing.assert_close(depth, torch.full_like(depth, 1.5 * 7.5 / length))
