"""Names of images: found by their ends, in other Unicode forms and with other extensions; masks are none of them."""

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image
from support.fixtures import World, write_colmap_text, write_transforms

from padgs.data import DataError, load
from padgs.data.assemble import image_names


@pytest.fixture
def folder(world: World, tmp_path: Path) -> Path:
    write_colmap_text(world, tmp_path / "scene")
    return tmp_path / "scene"


@pytest.fixture
def transforms(world: World, tmp_path: Path) -> Path:
    write_transforms(world, tmp_path / "scene")
    return tmp_path / "scene"


def _name(folder: Path, old: str, new: str) -> None:
    file = folder / "transforms.json"
    file.write_text(file.read_text().replace(f'"{old}', json.dumps(new)[:-1]))


@pytest.mark.parametrize(
    "prefix",
    ["/home/x/flat/images/", "C:\\scans\\images\\", "..\\images\\", "../../", "images\\", "./images/", "frames/"],
)
def test_names_are_taken_by_their_end(prefix: str, transforms: Path) -> None:
    names = [view.name for view in load(transforms).test]
    _name(transforms, "images/", prefix)
    scene = load(transforms)
    assert [view.name for view in scene.test] == names and len(scene.train) == 4
    differs = prefix not in ("images\\", "./images/")
    assert differs == any(note.startswith("images: 6 names differ from their files in folders") for note in scene.notes)


def test_names_without_image_say_what_differs(transforms: Path) -> None:
    _name(transforms, "images/pano_00", "/home/x/else")
    with pytest.raises(
        DataError, match="names '/home/x/else.png'; names must be relative .*remove the leading folders"
    ):
        load(transforms)
    _name(transforms, "/home/x/else", "/home/x/pano_01")
    with pytest.raises(DataError, match="names '/home/x/pano_01.png'; names must be relative"):
        load(transforms)  # the image of another frame


def test_smaller_copies_and_other_extensions(world: World, transforms: Path) -> None:
    (transforms / "images_2").mkdir()
    for name, image in zip(world.names, world.images, strict=True):
        Image.fromarray(image[::2, ::2]).save(transforms / "images_2" / f"{name}.JPG")
    scene = load(transforms, images="images_2")
    assert scene.train[0].width == 32 and [view.name for view in scene.test] == list(world.test)
    assert any("'pano_00.png' is images_2/pano_00.JPG" in note for note in scene.notes)


def test_unicode_forms_of_names(folder: Path) -> None:
    composed, decomposed = "k\u00fcche", "ku\u0308che"
    for path in (folder / "images").iterdir():
        path.rename(path.with_name(path.name.replace("pano", decomposed)))
    for file in ("sparse/0/images.txt", "train.txt", "test.txt"):
        (folder / file).write_text((folder / file).read_text().replace("pano", composed), encoding="utf-8")
    (folder / "masks").mkdir()
    Image.new("L", (64, 32), 200).save(folder / "masks" / f"{composed}_01.png")
    scene = load(folder)
    assert [view.name for view in scene.test] == [f"{decomposed}_01", f"{decomposed}_04"]
    assert scene.test[0].mask() is not None


def test_two_files_for_one_name_are_not_chosen_from(transforms: Path) -> None:
    for extension in ("webp", "bmp"):
        shutil.copy(transforms / "images/pano_00.png", transforms / f"images/other.{extension}")
    _name(transforms, "images/pano_00", "images/other")
    with pytest.raises(DataError, match="'other.png' of the transforms data set may be other.bmp, other.webp; remove"):
        load(transforms)


def test_a_mask_in_another_unicode_form_than_its_image_is_no_image(tmp_path: Path) -> None:
    for name in ("k\u00fcche.jpg", "ku\u0308che_mask.png"):
        (tmp_path / name).touch()
    assert image_names(tmp_path) == ["k\u00fcche.jpg"]
