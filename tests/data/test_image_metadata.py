"""Statements of image files about their pixels: read and applied, or refused with a remedy."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms
from support.fixtures import World, write_colmap_text

from padgs.data import DataError, load
from padgs.data.image_metadata import _CROP_PROPERTIES
from padgs.data.images import decode, inspect
from padgs.data.prepare.sources import find_source
from padgs.reports.store import split_image

XMP = b"XML:com.adobe.xmp\0\0\0\0\0"  # begins the chunk iTXt of a PNG
PIXELS = np.random.default_rng(3).integers(0, 256, (64, 128, 3), dtype=np.uint8)
PANORAMA = Image.fromarray(PIXELS)
GPANO = {
    "ProjectionType": "equirectangular",
    "FullPanoWidthPixels": 160,
    "FullPanoHeightPixels": 80,
    "CroppedAreaImageWidthPixels": 128,
    "CroppedAreaImageHeightPixels": 64,
    "CroppedAreaLeftPixels": 20,
    "CroppedAreaTopPixels": 6,
}


def xmp(elements: bool = False, **properties: object) -> bytes:
    if elements:
        body = ">" + "".join(f"<GPano:{name}>{value}</GPano:{name}>" for name, value in properties.items())
    else:
        body = "".join(f' GPano:{name}="{value}"' for name, value in properties.items()) + ">"
    return f"<x:xmpmeta><rdf:RDF><rdf:Description{body}</rdf:Description></rdf:RDF></x:xmpmeta>".encode()


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def with_chunk(path: Path, image: Image.Image, chunk: bytes, before: bytes = b"IDAT") -> Path:
    """Save a PNG with a chunk added before another one."""
    file = io.BytesIO()
    image.save(file, "PNG")
    place = file.getvalue().index(before) - 4
    path.write_bytes(file.getvalue()[:place] + chunk + file.getvalue()[place:])
    return path


@pytest.mark.parametrize("elements", [False, True])
@pytest.mark.parametrize("extension", ["jpg", "webp", "tif", "png", "late.png"])
def test_a_part_of_a_panorama_is_padded(extension, elements, tmp_path):
    path, packet = tmp_path / f"a.{extension}", xmp(elements, **GPANO)
    if "png" in extension:
        text = png_chunk(b"iTXt", XMP + packet)
        with_chunk(path, PANORAMA, text, before=b"IEND" if "late" in extension else b"IDAT")
    elif extension == "tif":
        PANORAMA.save(path, tiffinfo={700: packet})
    else:
        PANORAMA.save(
            path, xmp=packet, **({"lossless": True} if extension == "webp" else {"quality": 95, "subsampling": 0})
        )
    found, pixels = inspect(path), decode(path)
    assert (found.width, found.height) == (160, 80) and pixels.shape == (80, 160, 3)
    inside = pixels[6:70, 20:148].astype(int)
    assert np.abs(inside - PIXELS).mean() < (20 if extension == "jpg" else 0.1)
    assert pixels.sum() == inside.sum()


def test_unreadable_exif_is_no_damage_of_the_image(tmp_path):
    PANORAMA.save(tmp_path / "a.png", exif=b"Exif\0\0no tags")
    with pytest.raises(DataError, match=r"a.png has EXIF data that cannot be read .*remove the metadata \(`exiftool"):
        inspect(tmp_path / "a.png")


def test_sizes_of_a_part_are_scaled_with_the_picture_and_a_whole_panorama_is_no_part(tmp_path):
    larger = {name: value if isinstance(value, str) else 10.0 * value for name, value in GPANO.items()}
    PANORAMA.save(tmp_path / "a.jpg", xmp=xmp(**larger))
    found = inspect(tmp_path / "a.jpg")
    assert found.crop is not None and (found.crop.left, found.crop.top, found.width) == (20, 6, 160)
    whole = {"FullPanoWidthPixels": 1024, "FullPanoHeightPixels": 512}
    PANORAMA.save(
        tmp_path / "a.jpg",
        xmp=xmp(**whole, CroppedAreaImageWidthPixels=1024, CroppedAreaImageHeightPixels=512, CroppedAreaLeftPixels=0),
    )
    found = inspect(tmp_path / "a.jpg")
    assert found.crop is None and (found.width, found.height) == (128, 64)
    PANORAMA.save(tmp_path / "a.jpg", xmp=xmp(**whole))
    assert inspect(tmp_path / "a.jpg").crop is None, "resized, and no part is stated"
    for height in (32, 63):  # was stated before the picture was filled up
        stated = {"FullPanoWidthPixels": 128, "FullPanoHeightPixels": 64, "CroppedAreaImageHeightPixels": height}
        PANORAMA.save(tmp_path / "a.jpg", xmp=xmp(**stated, CroppedAreaImageWidthPixels=2 * height))
        assert inspect(tmp_path / "a.jpg").crop is None


def test_a_photograph_is_no_part_of_a_panorama(tmp_path):
    PANORAMA.save(tmp_path / "a.jpg", xmp=xmp(**GPANO))
    with pytest.raises(DataError, match="is a photograph, and says that it is a part of a panorama; remove the"):
        inspect(tmp_path / "a.jpg", panorama=False)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ProjectionType": "cylindrical"}, "says that its projection is 'cylindrical', not equirectangular"),
        ({"CroppedAreaLeftPixels": 100}, "contradicts itself: it is 128x64 and says .*CroppedAreaLeftPixels 100"),
        ({"FullPanoWidthPixels": "wide"}, "contradicts itself"),
        ({"CroppedAreaImageWidthPixels": 0}, "contradicts itself"),
        ({"CroppedAreaImageHeightPixels": 20}, "contradicts itself"),
        ({"FullPanoHeightPixels": 79}, "says that it is a part of a panorama of 160x79, which is not 2:1; correct"),
        ({"StereoMode": "top-bottom"}, r"says that it is stereo \(top-bottom\)"),
        ({"Orientation": 6}, "carries XMP orientation 6"),
    ],
)
def test_other_projections_contradictions_and_stereo_are_refused(changes, message, tmp_path):
    PANORAMA.save(tmp_path / "a.jpg", xmp=xmp(**GPANO | changes))
    with pytest.raises(DataError, match=f"a.jpg {message}"):
        inspect(tmp_path / "a.jpg")


@pytest.mark.parametrize("width", [*range(399, 412), 2000])
@pytest.mark.parametrize("box", [(0, 510, 4000, 1000), (1210, 430, 1500, 1130)])
def test_a_resized_part_lies_where_it_was(box, width, tmp_path):
    left, top, right, bottom = box[0], box[1], box[0] + box[2], box[1] + box[3]
    stated = (4000, 2000, box[2], box[3], left, top)
    packet = xmp(**dict(zip(_CROP_PROPERTIES, stated, strict=True)))
    Image.new("RGB", (width, round(width * box[3] / box[2])), "white").save(tmp_path / "a.jpg", xmp=packet)
    found, pixels = inspect(tmp_path / "a.jpg"), decode(tmp_path / "a.jpg")
    assert found.width == 2 * found.height and pixels.shape == (found.height, found.width, 3)
    scale = found.width / 4000
    assert scale == pytest.approx(width / box[2], abs=1.5 / 2000)
    rows, columns = np.nonzero(pixels[..., 0] > 128)
    edges = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
    assert edges == pytest.approx([scale * edge for edge in (left, right, top, bottom)], abs=0.51)


@pytest.mark.parametrize("part", [(16, 8, 32, 16), (16, 4, 20, 16)])
def test_a_mask_of_the_size_of_a_part_lies_where_it_lies(part, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    name = world.names[0]
    left, top, width, height = part
    picture = Image.fromarray(world.images[0]).crop((left, top, left + width, top + height))
    sizes = zip(_CROP_PROPERTIES, (64, 32, width, height, left, top), strict=True)
    with_chunk(tmp_path / "images" / f"{name}.png", picture, png_chunk(b"iTXt", XMP + xmp(**dict(sizes))))
    mask = np.full((height, width), 255, np.uint8)
    mask[: height // 4] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / f"{name}.png")
    scene = load(tmp_path, disk_cache="off")
    (weights,) = (view.mask() for view in (*scene.train, *scene.test) if view.name == name)
    expected = np.zeros((32, 64))
    expected[top + height // 4 : top + height, left : left + width] = 1
    assert np.array_equal(weights.numpy(), expected)


def test_what_a_part_does_not_show_is_masked(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    first, second = world.names[:2]
    path = tmp_path / "images" / f"{first}.png"
    part = Image.fromarray(world.images[0][8:24, 16:48])
    packet = xmp(FullPanoWidthPixels=64, FullPanoHeightPixels=32, CroppedAreaLeftPixels=16, CroppedAreaTopPixels=8)
    with_chunk(path, part, png_chunk(b"iTXt", XMP + packet))
    for mask in ("auto", "none"):
        scene = load(tmp_path, mask=mask)
        views = {view.name: view for view in (*scene.train, *scene.test)}
        weights = views[first].mask()
        assert weights is not None and weights[8:24, 16:48].min() == 1 and weights.sum() == 16 * 32
        assert views[second].mask() is None
        assert any(f"the rest is masked: {first}.png" in note for note in scene.notes)
    assert load(tmp_path, mask="rows:12/32").train[0].mask().sum() == 4 * 32
    half = load(tmp_path, width=32)
    assert half.train[0].mask().sum() == 8 * 16
    source = find_source(tmp_path / "images", "auto")
    assert source.masks[f"{first}.png"]().sum() == 16 * 32 and "the rest is masked" in source.notes[0]


def test_a_part_that_a_reconstruction_took_for_the_whole_is_refused(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)  # with cameras of 64x32
    packet = xmp(FullPanoWidthPixels=128, FullPanoHeightPixels=64, CroppedAreaLeftPixels=32, CroppedAreaTopPixels=16)
    for name, image in zip(world.names, world.images, strict=True):
        path = tmp_path / "images" / f"{name}.png"
        with_chunk(path, Image.fromarray(image), png_chunk(b"iTXt", XMP + packet))
    with pytest.raises(DataError, match="is 128x64, its camera 64x32, which takes a part of a panorama for the whole"):
        load(tmp_path)


def test_colours_are_converted_to_srgb(tmp_path):
    grey = Image.fromarray(np.full((64, 128, 3), 55, np.uint8))
    linear = with_chunk(tmp_path / "linear.png", grey, png_chunk(b"gAMA", struct.pack(">I", 100_000)))
    assert inspect(linear).converted and np.unique(decode(linear)).tolist() == [128]  # 55 / 255 of the light
    usual = with_chunk(tmp_path / "usual.png", grey, png_chunk(b"gAMA", struct.pack(">I", 45_455)))
    assert not inspect(usual).converted and np.unique(decode(usual)).tolist() == [55]
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    PANORAMA.save(tmp_path / "srgb.png", icc_profile=profile)
    assert not inspect(tmp_path / "srgb.png").converted and np.array_equal(decode(tmp_path / "srgb.png"), PIXELS)
    swapped = profile.replace(b"rXYZ", b"tXYZ").replace(b"gXYZ", b"rXYZ").replace(b"tXYZ", b"gXYZ")
    PANORAMA.save(tmp_path / "swapped.png", icc_profile=swapped)  # with the primaries of red and green exchanged
    assert inspect(tmp_path / "swapped.png").converted
    assert np.abs(decode(tmp_path / "swapped.png").astype(int) - PIXELS[..., [1, 0, 2]]).mean() < 3
    grey.save(tmp_path / "grey.png", icc_profile=swapped)  # a mask has no colours
    assert np.unique(decode(tmp_path / "grey.png", "L")).tolist() == [55]


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (png_chunk(b"cICP", bytes((9, 16, 0, 1))), r"colours of video or HDR \(cICP \[9, 16, 0, 1\]\)"),
        (png_chunk(b"cHRM", struct.pack(">8I", *(31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000))), "primaries"),
        (png_chunk(b"gAMA", struct.pack(">I", 1)), "gamma 1e-05"),
        (png_chunk(b"iCCP", b"x\0\0" + zlib.compress(b"no profile" * 20)), "an ICC profile that cannot be applied"),
    ],
)
def test_colours_of_other_kinds_are_refused(chunk, message, tmp_path):
    with pytest.raises(DataError, match=f"a.png .*{message}.*8-bit sRGB"):
        inspect(with_chunk(tmp_path / "a.png", PANORAMA, chunk))


@pytest.mark.parametrize("extension", ["png", "webp", "tif"])
def test_several_pictures_are_refused(extension, tmp_path):
    PANORAMA.save(tmp_path / f"a.{extension}", save_all=True, append_images=[Image.fromarray(255 - PIXELS)])
    with pytest.raises(DataError, match=f"a.{extension} holds 2 pictures .*save the one that is meant"):
        inspect(tmp_path / f"a.{extension}")


@pytest.mark.parametrize(("kind", "refused"), [(0x030000, False), (0x020002, True), (0x020003, True)])
def test_pictures_of_two_eyes_in_a_jpeg_are_refused_but_not_previews(kind, refused, tmp_path):
    PANORAMA.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[PANORAMA.resize((32, 16))])
    data = (tmp_path / "a.jpg").read_bytes()
    primary = struct.pack("<II", 0x030000, data.index(b"\xff\xd9\xff\xd8") + 2)  # type and size
    assert data.count(primary) == 1
    (tmp_path / "a.jpg").write_bytes(data.replace(primary, struct.pack("<I", kind) + primary[4:]))
    if refused:
        with pytest.raises(DataError, match="a.jpg holds 2 pictures"):
            inspect(tmp_path / "a.jpg")
    else:
        assert decode(tmp_path / "a.jpg").shape == (64, 128, 3)


@pytest.mark.parametrize("kind", ["palette", "colour key", "grey mask"])
def test_transparency_without_an_alpha_channel_is_refused(kind, tmp_path):
    image = PANORAMA.quantize(16) if kind == "palette" else PANORAMA.convert("L") if "mask" in kind else PANORAMA
    key = {"palette": bytes((255, 0)), "colour key": tuple(map(int, PIXELS[3, 3])), "grey mask": 77}[kind]
    image.save(tmp_path / "a.png", transparency=key)
    with pytest.raises(DataError, match="a.png has transparent pixels"):
        inspect(tmp_path / "a.png", mask="mask" in kind)
    if kind == "palette":
        image.save(tmp_path / "a.png", transparency=bytes((255, 255)))  # which no pixel uses
        assert np.array_equal(decode(tmp_path / "a.png"), np.asarray(image.convert("RGB")))


def test_sixteen_bit_colour_png(tmp_path):
    rows = zlib.compress(b"".join(b"\0" + bytes(8 * 6) for _ in range(4)))
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", 8, 4, 16, 2, 0, 0, 0)), (b"IDAT", rows), (b"IEND", b""))
    path = tmp_path / "a.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*chunk) for chunk in chunks))
    with Image.open(path) as image:
        assert image.mode == "RGB", "Pillow does not tell"
    with pytest.raises(DataError, match="a.png has 16 bits or more"):
        inspect(path)


@pytest.mark.parametrize("before", [b"IDAT", b"IEND"])
def test_long_texts_in_a_file_name_the_file(before, tmp_path):
    text = png_chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(3 << 20)))
    path = with_chunk(tmp_path / "a.png", PANORAMA, text, before)
    with pytest.raises(OSError, match=r"a.png .*[Dd]ecompressed data too large"):
        split_image(path, 3)
    for look in (inspect, decode) if before == b"IDAT" else (decode,):
        with pytest.raises(DataError, match=r"a.png .*[Dd]ecompressed data too large"):
            look(path)
