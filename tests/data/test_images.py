"""Image files: checks, decoding, and detection of dual-fisheye images."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.fixtures import World, write_colmap_text

from padgs import files
from padgs.data import DataError
from padgs.data.check import check
from padgs.data.images import decode, inspect, is_dual_fisheye
from padgs.data.prepare.pipeline import prepare
from padgs.data.prepare.sources import find_source
from padgs.geometry.panorama import sample
from padgs.reports.store import split_image

PIXELS = np.random.default_rng(3).integers(0, 256, (64, 128, 3), dtype=np.uint8)


def _save(path: Path, image: Image.Image, **options: object) -> Path:
    image.save(path, **options)
    return path


@pytest.mark.parametrize("extension", ["png", "jpg", "tif", "webp", "bmp"])
def test_panoramas_pass_and_decode(extension: str, tmp_path: Path) -> None:
    path = _save(tmp_path / f"grüße {extension}.{extension}", Image.fromarray(PIXELS))
    found = inspect(path)
    assert (found.width, found.height) == (128, 64)
    assert decode(path).shape == (64, 128, 3)
    if extension in ("png", "tif", "bmp"):
        assert np.array_equal(decode(path), PIXELS)


def test_palettes_and_opaque_alpha_are_colour(tmp_path: Path) -> None:
    palette = Image.fromarray(PIXELS).quantize(64)
    path = _save(tmp_path / "palette.png", palette)
    inspect(path)
    assert np.array_equal(decode(path), np.asarray(palette.convert("RGB")))
    opaque = _save(tmp_path / "opaque.png", Image.fromarray(PIXELS).convert("RGBA"))
    assert np.array_equal(decode(opaque), PIXELS)


def test_transparent_pixels_are_refused(tmp_path: Path) -> None:
    image = Image.fromarray(PIXELS).convert("RGBA")
    image.putpixel((3, 3), (0, 0, 0, 254))
    path = _save(tmp_path / "a.png", image)
    for look in (inspect, decode):
        with pytest.raises(DataError, match=r"a.png has transparent pixels; .* in a mask file"):
            look(path)
    with pytest.raises(DataError, match=r"a.png has transparent pixels; save it without alpha, and paint .* black"):
        inspect(path, mask=True)


@pytest.mark.parametrize("extension", ["jpg", "png"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.98])
def test_truncated_files_are_refused_by_inspect(extension: str, share: float, tmp_path: Path) -> None:
    path = _save(tmp_path / f"a.{extension}", Image.fromarray(PIXELS))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DataError, match=rf"a.{extension} is cut short or damaged .*copy it again"):
        inspect(path)


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"subsampling": 0}], ids=str)
def test_truncated_jpegs_with_an_end_marker_are_refused_by_decode(options, tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(PIXELS).save(path, **options)
    whole = path.read_bytes()
    assert decode(path).shape == PIXELS.shape
    path.write_bytes(whole[: len(whole) // 2] + b"\xff\xd9")
    inspect(path)
    with pytest.raises(DataError, match="a.jpg is cut short, although it has an end marker; copy it again"):
        decode(path)


@pytest.mark.parametrize("extension", ["jpg", "png"])
def test_files_that_end_in_zeros_are_refused(extension: str, tmp_path: Path) -> None:
    path = _save(tmp_path / f"a.{extension}", PANORAMA)
    data = path.read_bytes()
    path.write_bytes(data + bytes(300))
    assert inspect(path).width == 128
    path.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))
    with pytest.raises(DataError, match=r"a.\w+ ends in zeros, as after an interrupted download; copy it again"):
        inspect(path)


@pytest.mark.parametrize("width", [127, 129])
def test_images_that_are_nearly_2_to_1_are_to_be_resized(width: int, tmp_path: Path) -> None:
    path = _save(tmp_path / "a.png", PANORAMA.resize((width, 64)))
    with pytest.raises(DataError, match=r"not 2:1; .* \(if it is whole, resize it: `mogrify -resize 128x64! FILE`\)"):
        inspect(path)


def test_a_grey_nadir_is_not_taken_as_truncation(tmp_path: Path) -> None:
    pixels = PIXELS.copy()
    pixels[-20:] = 128
    Image.fromarray(pixels).save(tmp_path / "a.jpg")
    assert (decode(tmp_path / "a.jpg")[-1] == 128).all()


def test_thumbnails_and_trailing_bytes_do_not_mislead_the_truncation_test(tmp_path: Path) -> None:
    path = _save(tmp_path / "a.jpg", Image.fromarray(PIXELS))
    thumbnail = b"\xff\xd8 a small image \xff\xda and its end \xff\xd9"
    data = path.read_bytes()
    whole = data[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + data[2:]
    path.write_bytes(whole[:-500])
    with pytest.raises(DataError, match="cut short"):
        inspect(path)
    path.write_bytes(whole + b"trailer of some camera \xff\xda")
    inspect(path)


PANORAMA, GREY = Image.fromarray(PIXELS), Image.fromarray(PIXELS[..., 0])


@pytest.mark.parametrize(
    ("name", "image", "message", "as_mask"),
    [
        ("a.png", GREY, r"is grey \(L\); .* convert it", None),
        ("a.jpg", GREY, r"is grey \(L\)", None),
        ("a.png", Image.fromarray(PIXELS[..., 0].astype(np.uint16) * 257), "has 16 bits or more", None),
        ("a.tif", PANORAMA.convert("F"), "has 16 bits or more", "has pixels of type F"),
        ("a.tif", PANORAMA.convert("I"), "has 16 bits or more", "has pixels of type I"),
        ("a.jpg", PANORAMA.convert("CMYK"), "is CMYK; convert it to RGB", "has pixels of type CMYK"),
        ("a.tif", PANORAMA.convert("LAB"), "is LAB; convert it to RGB", "has pixels of type LAB; save masks as grey"),
        (
            "a.png",
            Image.fromarray(PIXELS[:, :64]),
            "is 64x64, which is not 2:1; .*360 x 180.* one above the other",
            "not 2:1",
        ),
        ("a.png", Image.fromarray(PIXELS[:32]), "is 128x32, which is not 2:1.*two panoramas side by side", "not 2:1"),
        ("a.png", Image.fromarray(PIXELS[:63]), "is 128x63, which is not 2:1", "is not 2:1"),
    ],
)
def test_other_modes_and_shapes_are_refused(name: str, image: Image.Image, message: str, as_mask, tmp_path: Path):
    path = _save(tmp_path / name, image)
    with pytest.raises(DataError, match=f"{name} {message}"):
        inspect(path)
    if as_mask is None:
        inspect(path, mask=True)
    else:
        with pytest.raises(DataError, match=f"{name} .*{as_mask}"):
            inspect(path, mask=True)


@pytest.mark.parametrize(("flag", "fine"), [(1, True), (0, True), (3, False), (6, False), (8, False)])
@pytest.mark.parametrize("extension", ["jpg", "png"])
def test_orientation_flags(flag: int, fine: bool, extension: str, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = flag
    path = _save(tmp_path / f"a.{extension}", Image.fromarray(PIXELS), exif=exif.tobytes())
    if fine:
        inspect(path)
    else:
        with pytest.raises(DataError, match=f"carries EXIF orientation {flag}: .*remove the flag"):
            inspect(path)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    text, empty, forbidden = tmp_path / "a.jpg", tmp_path / "b.jpg", tmp_path / "c.jpg"
    text.write_text("<html>404</html>")
    empty.touch()
    with pytest.raises(DataError, match=r"a.jpg is not an image in JPEG, PNG"):
        inspect(text)
    with pytest.raises(DataError, match=r"b.jpg is empty \(0 bytes\)"):
        inspect(empty)
    with pytest.raises(DataError, match=r"absent.jpg does not exist"):
        inspect(tmp_path / "absent.jpg")
    with pytest.raises(DataError, match="cannot be read"):
        inspect(tmp_path)
    if os.geteuid() != 0:  # root may read everything
        _save(forbidden, Image.fromarray(PIXELS)).chmod(0)
        with pytest.raises(DataError, match=r"c.jpg cannot be read \(Permission denied\); check its permissions"):
            inspect(forbidden)


FISHEYE_SIZE = 96
FISHEYE_FIELD = math.radians(190)  # of each lens


def dual_fisheye(panorama: np.ndarray, *, noise: int = 6, radius: float = 1.0) -> np.ndarray:
    """Project a panorama to two equidistant fisheye lenses, forward and backward; [S, 2 S, 3] uint8."""
    step = (torch.arange(FISHEYE_SIZE) + 0.5) / FISHEYE_SIZE * 2 - 1
    down, right = torch.meshgrid(step, step, indexing="ij")
    distance = torch.hypot(right, down) / radius
    angle = distance * FISHEYE_FIELD / 2
    across = angle.sin() / distance / radius
    rays = torch.stack((right * across, down * across, angle.cos()), dim=-1)
    halves = [rays, rays * torch.tensor([-1.0, 1.0, -1.0])]
    image = torch.from_numpy(panorama).float() / 255
    seen = torch.cat([sample(image, half) * (distance <= 1)[..., None] for half in halves], dim=1)
    random = np.random.default_rng(0).integers(0, noise, (FISHEYE_SIZE, 2 * FISHEYE_SIZE, 1))
    return (seen.numpy() * 255 + random).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("radius", [0.94, 1.0, 1.04])
def test_dual_fisheye_images_are_detected(radius: float, world: World) -> None:
    assert is_dual_fisheye(dual_fisheye(world.images[0], radius=radius))


def test_panoramas_are_not_taken_as_dual_fisheye(world: World) -> None:
    night = (world.images[0] * 0.05).astype(np.uint8)
    capped = world.images[0].copy()
    capped[:8] = capped[-8:] = 0  # what a stitcher leaves where no lens looked
    one = dual_fisheye(world.images[0])
    one[:, FISHEYE_SIZE:] = world.images[0][0, 0]
    for image in (*world.images, night, capped, np.zeros_like(night), one):
        assert not is_dual_fisheye(image)


def test_prepare_and_check_refuse_dual_fisheye_images(world: World, tmp_path: Path) -> None:
    for name in world.names:
        Image.fromarray(dual_fisheye(world.images[0])).save(tmp_path / f"{name}.jpg", quality=80)
    with pytest.raises(DataError, match=r"pano_00.jpg shows two circles side by side.* Stitch it with the program"):
        find_source(tmp_path, "auto")
    write_colmap_text(world, tmp_path / "posed")
    (tmp_path / "pano_02.jpg").rename(tmp_path / "posed/images/pano_02.png")
    assert any("pano_02.png shows two circles" in problem for problem in check(tmp_path / "posed").problems)


EPS = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 128 64
%%EndComments
(ran.txt) (w) file closefile
%%EOF
"""


@pytest.mark.parametrize("kind", ["EPS", "GIF", "DDS", "ICO", "PCX", "TGA", "PPM"])
def test_other_formats_are_refused_whatever_the_extension_says(kind, world, tmp_path, monkeypatch):
    """The decoder of EPS runs Ghostscript, which runs the program in the file."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.jpg"
    if kind == "EPS":
        path.write_bytes(EPS)
    else:
        Image.fromarray(PIXELS).save(path, kind)
    Image.init()  # all decoders of Pillow are known from here on
    for look in (inspect, lambda path: inspect(path, mask=True), decode):
        with pytest.raises(DataError, match="a.jpg"):
            look(path)
    with pytest.raises(OSError, match=f"a.jpg is not an image in JPEG, PNG.*{'' if kind == 'TGA' else kind}"):
        split_image(path, 3)
    (tmp_path / "in").mkdir()
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / "in" / name).write_bytes(path.read_bytes())
    with pytest.raises(DataError, match=r"a.jpg is not an image in JPEG, PNG"):
        prepare(tmp_path / "in", tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.jpg", "in"], "no ran.txt, and no folder out"
    write_colmap_text(world, tmp_path / "world")
    first = sorted((tmp_path / "world" / "images").iterdir())[0]
    first.write_bytes(path.read_bytes())
    assert any(f"{first.name} is not an image in JPEG, PNG" in text for text in check(tmp_path / "world").problems)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_what_is_no_regular_file_is_not_read(kind, tmp_path):
    for name in ("a.jpg", "tour.mp4"):
        os.mkfifo(tmp_path / name) if kind == "pipe" else (tmp_path / name).symlink_to("/dev/zero")
    for look in (inspect, decode, lambda path: split_image(path, 3)):
        with pytest.raises((DataError, OSError), match=r"a.jpg .*no.* regular file"):
            look(tmp_path / "a.jpg")
    with pytest.raises(DataError, match=r"tour.mp4 cannot be read \(it is no regular file\)"):
        prepare(tmp_path / "tour.mp4", tmp_path / "out")


def test_images_beyond_the_limit_are_refused_with_the_limit(tmp_path, monkeypatch):
    path = _save(tmp_path / "a.png", Image.fromarray(PIXELS))
    monkeypatch.setattr(files, "MAX_PIXELS", 64 * 64)
    with pytest.raises(DataError, match=r"a.png is too large: .*\(128x64\), .*; reduce it to 90x45 or less"):
        inspect(path)
