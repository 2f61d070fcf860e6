"""The tiny world, once for all tests of data sources; and narrow pictures of it."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin
from support.fixtures import World, make_world, write_colmap_text

GPANO = (
    'GPano:FullPanoWidthPixels="96" GPano:FullPanoHeightPixels="48" GPano:CroppedAreaImageWidthPixels="32" '
    'GPano:CroppedAreaImageHeightPixels="16" GPano:CroppedAreaLeftPixels="32" GPano:CroppedAreaTopPixels="16"'
)


@pytest.fixture(scope="session")
def world() -> World:
    return make_world()


@pytest.fixture
def narrow(tmp_path: Path) -> Path:
    """A COLMAP model with pictures of 120 x 60 degrees, which say where they lie in a panorama of 96 x 48 pixels."""
    world, folder = make_world(width=96), tmp_path / "narrow"
    write_colmap_text(world, folder)
    said = PngImagePlugin.PngInfo()
    said.add_itxt("XML:com.adobe.xmp", f"<x:xmpmeta><rdf:RDF><rdf:Description {GPANO}/></rdf:RDF></x:xmpmeta>")
    for name, image in zip(world.names, world.images, strict=True):
        picture = np.ascontiguousarray(image[16:32, 32:64])
        Image.fromarray(picture).save(folder / "images" / f"{name}.png", pnginfo=said)
    return folder
