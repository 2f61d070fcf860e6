"""Masks: files, rules, weights and errors."""

import json
import shutil
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.fixtures import World, write_colmap_text, write_transforms

from padgs.data import DataError, load
from padgs.data.check import check
from padgs.data.masks import row_weights, write_masks
from padgs.data.prepare.work import Prepared, PrepareOptions


@pytest.fixture
def folder(world: World, tmp_path: Path) -> Path:
    write_colmap_text(world, tmp_path)
    return tmp_path


def _mask(path: Path, hidden_rows: int = 8, size: tuple[int, int] = (64, 32)) -> None:
    path.parent.mkdir(exist_ok=True)
    mask = np.full((size[1], size[0]), 255, np.uint8)
    mask[size[1] - hidden_rows :] = 0
    Image.fromarray(mask).save(path)


def test_row_weights_scale_with_the_height() -> None:
    assert torch.equal(row_weights(959, 1024, 1024)[:, 0], (torch.arange(1024) < 959).float())
    half = row_weights(959, 1024, 512)[:, 0]
    assert half[478:481].tolist() == [1.0, 0.5, 0.0]
    assert half.sum() == 479.5


@pytest.mark.parametrize("name", ["mask.png", "mask.tif", "mask.jpeg", "mask.webp"])
def test_one_mask_for_the_scene(name: str, folder: Path) -> None:
    _mask(folder / name)
    scene = load(folder, width=32)
    for view in (*scene.train, *scene.test):
        mask = view.mask()
        assert mask is not None and mask.shape == (16, 32)
        assert mask[:12].eq(1).all() and mask[12:].eq(0).all()
    assert f"mask: {name} for every view" in scene.notes
    assert load(folder, mask="none").train[0].mask() is None


@pytest.mark.parametrize(
    "file",
    [f"{folder}/{name}" for folder in ("masks", "mask") for name in ("pano_00.png", "pano_00.png.png", "PANO_00.BMP")]
    + [
        "masks/pano_00_mask.jpg",
        "images/pano_00_mask.png",
        "images/pano_00.png.png",
        "images/dynamic_mask_pano_00.png",
        "images/mask_pano_00.png",
        "images/pano_00.png.mask.png",
        *(f"images/{folder}/{name}" for folder in ("masks", "mask") for name in ("pano_00.png", "pano_00_mask.jpg")),
    ],
)
def test_habits_of_other_programs(file: str, folder: Path) -> None:
    _mask(folder / file, hidden_rows=12)
    scene = load(folder)
    views = {view.name: view for view in (*scene.train, *scene.test)}
    hidden = 20 if "dynamic" in file else 12  # white is ignored there
    torch.testing.assert_close(views["pano_00"].mask().sum(), torch.tensor((32.0 - hidden) * 64), atol=9, rtol=0)
    assert views["pano_02"].mask() is None and len(views) == 6
    assert any(note.startswith(f"masks: {Path(file).parent.name}/ for 1 of 6 views") for note in scene.notes)
    assert not any("no pose" in note for note in scene.notes)


def test_subfolders_are_the_same_in_any_case_and_unicode_form(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    listing, images = tmp_path / "sparse/0/images.txt", tmp_path / "images"
    text = listing.read_text()
    for name, folder in zip((world.names[0], world.names[3]), ("K\u00fcche", "Cam1"), strict=True):
        (images / folder).mkdir()
        (images / f"{name}.png").rename(images / folder / f"{name}.png")
        text = text.replace(f"{name}.png", f"{folder}/{name}.png")
    listing.write_text(text)
    (tmp_path / "masks").mkdir()
    _mask(tmp_path / "masks" / "Ku\u0308che" / f"{world.names[0]}.png")
    _mask(tmp_path / "masks" / "cam1" / f"{world.names[3]}.png")
    for name in ("round", "again"):  # links in circles end
        (tmp_path / "masks" / name).symlink_to(tmp_path / "masks")
    assert any("masks/ for 2 of 6 views" in note for note in load(tmp_path).notes)


def test_masks_in_folders_of_other_names_are_noted(folder: Path) -> None:
    _mask(folder / "sam_masks" / "pano_00.png")
    assert "masks: not used: sam_masks; name one with data.mask" in load(folder).notes
    assert "masks: sam_masks/ for 1 of 6 views" in load(folder, mask="sam_masks").notes


def test_inverted_masks_are_asked_about_and_inverted(folder: Path) -> None:
    plain = load(folder).fingerprint
    for i, name in enumerate(("pano_00", "pano_01", "pano_02")):
        _mask(folder / "masks" / f"{name}.png", hidden_rows=26 + i)
    question = (
        "the masks hide 9.% of the sphere, in pano_00.png, .* set data.mask=inverted; if that is meant, set data.m"
    )
    with pytest.raises(DataError, match=f"{question}ask=masks"):
        load(folder)
    shown = [load(folder, mask=spec).train[0].mask().mean().item() for spec in ("masks", "inverted", "inverted:masks")]
    assert shown == [6 / 32, 26 / 32, 26 / 32]
    assert "the masks hide 94% of the sphere, as data.mask=masks says" in load(folder, mask="masks").notes
    assert len({plain, *(load(folder, mask=spec).fingerprint for spec in ("masks", "inverted"))}) == 3
    with pytest.raises(DataError, match="data.mask=inverted:none: there are no mask files to invert"):
        load(folder, mask="inverted:none")


def test_masks_that_prepare_wrote_may_hide_most_and_others_are_asked_about(folder: Path) -> None:
    prepared = Prepared(folder, (), (), 0, 0)
    prepared.write(folder, PrepareOptions(), "")
    for name in ("pano_00", "pano_01", "pano_02"):
        _mask(folder / "masks" / f"{name}.png", hidden_rows=26)
    with pytest.raises(DataError, match="set data.mask=inverted"):  # put there by the user
        load(folder)
    prepared.write(folder, PrepareOptions(), "")  # as of narrow crops
    assert load(folder).train[0].mask().mean() == 6 / 32
    assert not [problem for problem in check(folder).problems if "masks" in problem]
    for name in ("pano_00", "pano_01", "pano_02"):
        _mask(folder / "masks" / f"{name}.png", hidden_rows=27)
    with pytest.raises(DataError, match="set data.mask=inverted"):
        load(folder)
    shutil.rmtree(folder / "masks")
    _mask(folder / "mask.png", hidden_rows=26)
    prepared.write(folder, PrepareOptions(), "")
    assert load(folder).train[0].mask().mean() == 6 / 32
    assert not [problem for problem in check(folder).problems if "mask" in problem]


@pytest.mark.parametrize("masks", ["masks", "mask.png", "images/masks"])
def test_masks_around_the_images_count_wherever_the_model_is(masks: str, folder: Path) -> None:
    names = [f"{masks}/pano_0{i}.png" for i in range(6)] if masks != "mask.png" else [masks]
    for name in names:
        _mask(folder / name, hidden_rows=26)
    options = {"images": str(folder / "images")}
    scene = load(folder / "sparse" / "0", mask="inverted", **options)
    assert scene.train[0].mask().mean() == 26 / 32 and scene.name == folder.name
    assert [view.name for view in scene.test] == ["pano_01", "pano_04"]
    where = "images" if masks.startswith("images") else masks
    with pytest.raises(DataError, match=f"if that is meant, set data.mask={where}$"):
        load(folder / "sparse" / "0", **options)
    assert load(folder / "sparse" / "0", mask=where, **options).train[0].mask().mean() == 6 / 32


def test_an_empty_folder_of_masks_is_none(folder: Path) -> None:
    (folder / "masks").mkdir()
    (folder / "masks" / ".gitkeep").touch()
    assert load(folder).train[0].mask() is None
    _mask(folder / "images" / "masks" / "pano_00.png", hidden_rows=12)
    assert load(folder).train[0].mask() is not None
    with pytest.raises(DataError, match="holds no mask named like an image"):
        load(folder, mask="masks")


def test_masks_in_one_folder_serve_images_in_several(world: World, folder: Path) -> None:
    listing = folder / "sparse/0/images.txt"
    for name, inside in zip(world.names[:3], ("left/a", "left/b", "right/b"), strict=True):
        (folder / "images" / inside).parent.mkdir(exist_ok=True)
        (folder / "images" / f"{name}.png").rename(folder / "images" / f"{inside}.png")
        for file in (listing, folder / "train.txt", folder / "test.txt"):
            file.write_text(file.read_text().replace(f"{name}.png", f"{inside}.png"))
    for name in ("a_mask", "b"):  # two images are called b
        _mask(folder / "masks" / f"{name}.png", hidden_rows=12)
    scene = load(folder)
    masked = [view.name for view in (*scene.train, *scene.test) if view.mask() is not None]
    assert masked == ["left/a"] and "masks: masks/ for 1 of 6 views; not used: b.png" in scene.notes


@pytest.mark.parametrize("file", ["masks/pano_00.png", "images/dynamic_mask_pano_00.png"])
def test_inverted_means_that_white_is_ignored_whatever_the_name(file: str, folder: Path) -> None:
    _mask(folder / file, hidden_rows=12)
    assert load(folder, mask="inverted").train[0].mask().mean() == 12 / 32


def test_masks_that_transforms_json_names_are_inverted_too(world: World, tmp_path: Path) -> None:
    write_transforms(world, tmp_path)
    data = json.loads((tmp_path / "transforms.json").read_text())
    for i, frame in enumerate(data["frames"]):
        frame["mask_path"] = f"ignore/m{i}.png"
        _mask(tmp_path / frame["mask_path"], hidden_rows=12)
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    assert [load(tmp_path, mask=spec).train[0].mask().mean() for spec in ("auto", "inverted")] == [20 / 32, 12 / 32]


def test_a_mask_for_the_scene_says_that_others_are_not_used(folder: Path) -> None:
    _mask(folder / "mask.png")
    _mask(folder / "masks" / "pano_00.png")
    assert "mask: mask.png for every view; masks/ is not used (data.mask=masks uses it)" in load(folder).notes


def test_masks_of_zeros_and_ones(folder: Path) -> None:
    Image.fromarray((np.arange(32 * 64).reshape(32, 64) < 1024).astype(np.uint8)).save(folder / "mask.png")
    assert load(folder).train[0].mask().mean() == 0.5


def test_grey_values_are_weights_and_rows_multiply(folder: Path) -> None:
    Image.fromarray(np.full((32, 64), 51, np.uint8)).save(folder / "weights.png")
    scene = load(folder, mask="weights.png")
    torch.testing.assert_close(scene.train[0].mask(), torch.full((32, 64), 0.2))
    _mask(folder / "mask.png")
    assert load(folder, mask="rows:16/32").train[0].mask().sum() == 16 * 64


def test_masks_do_not_change_pixels(folder: Path, world: World) -> None:
    _mask(folder / "mask.png")
    view = load(folder).train[0]
    assert torch.equal(view.load_pixels(), torch.from_numpy(world.images[world.names.index(view.name)]))


def test_a_mask_changes_the_fingerprint(folder: Path) -> None:
    plain = load(folder).fingerprint
    _mask(folder / "mask.png")
    first = load(folder).fingerprint
    _mask(folder / "mask.png", hidden_rows=9)
    assert len({plain, first, load(folder).fingerprint, load(folder, mask="rows:31/32").fingerprint}) == 4
    assert load(folder, mask="none").fingerprint == plain


def test_masks_that_hide_almost_everything_are_refused(folder: Path) -> None:
    mask = np.zeros((32, 64), np.uint8)
    mask[16, 3] = 255
    Image.fromarray(mask).save(folder / "pixel.png")
    with pytest.raises(DataError, match=r"pixel.png hides all but 0.08% of the sphere of pano_00.png; in a mask 255"):
        load(folder, mask="pixel.png")
    (folder / "{a} {}").mkdir()
    (folder / "pixel.png").rename(folder / "{a} {}" / "{b}.png")
    with pytest.raises(DataError, match=r"\{a\} \{\}/\{b\}.png hides all but 0.08% of the sphere of pano_00.png; in a"):
        load(folder, mask="{a} {}/{b}.png")
    with pytest.raises(DataError, match=r"data.mask=rows:1/32 hides all but 0.24% of the sphere of each image; keep"):
        load(folder, mask="rows:1/32")


def test_masks_relative_to_the_working_directory(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _mask(folder / "desk" / "hands.png")
    monkeypatch.chdir(folder / "desk")
    assert load(folder, mask="hands.png").train[0].mask() is not None
    _mask(folder / "hands.png")
    with pytest.raises(DataError, match=r"data.mask=hands.png is both .*hands.png and .*desk/hands.png; give"):
        load(folder, mask="hands.png")
    assert load(folder, mask=str(folder / "hands.png")).train[0].mask() is not None


def test_masks_that_the_data_set_states_are_its_own(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_transforms(world, tmp_path / "block")
    file = tmp_path / "block/transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"mask": "masks"}))
    for name in world.names:
        _mask(tmp_path / "block/masks" / f"{name}.png")
        _mask(tmp_path / "masks" / f"{name}.png", hidden_rows=9)
    monkeypatch.chdir(tmp_path)
    mask = load(tmp_path / "block").train[0].mask()
    assert mask is not None and mask[-9:].any()


def test_writing_masks_keeps_two_in_memory(tmp_path: Path) -> None:
    made: list[weakref.ref] = []
    alive: list[int] = []

    def loads(value: float) -> Callable[[], torch.Tensor]:
        def load() -> torch.Tensor:
            mask = torch.full((4, 8), value)
            made.append(weakref.ref(mask))
            alive.append(sum(known() is not None for known in made))
            return mask

        return load

    write_masks({name: loads(1.0) for name in "abcd"}, tmp_path / "same")
    write_masks({name: loads(1.0 if name < "d" else 0.2) for name in "abcd"}, tmp_path / "others")
    assert max(alive) == 2
    assert [path.name for path in (tmp_path / "same").iterdir()] == ["mask.png"]
    assert (np.asarray(Image.open(tmp_path / "others" / "masks" / "d.png")) == 51).all()


def test_unusable_masks(folder: Path) -> None:
    _mask(folder / "mask.png", size=(62, 31))
    with pytest.raises(DataError, match=r"mask.png is 62x31 but pano_00.png is 64x32; a mask must have the size"):
        load(folder)
    _mask(folder / "mask.png", hidden_rows=32)
    with pytest.raises(DataError, match=r"mask.png hides every pixel of pano_00.png; in a mask 255 means use"):
        load(folder)
    with pytest.raises(DataError, match="absent.png: no such file or folder; keywords: auto, none, inverted, rows"):
        load(folder, mask="absent.png")
    with pytest.raises(DataError, match="rows:40/32: the first number"):
        load(folder, mask="rows:40/32")
    (folder / "empty").mkdir()
    with pytest.raises(DataError, match="holds no mask named like an image"):
        load(folder, mask="empty")


@pytest.mark.parametrize(
    ("values", "mode"),
    [((0, 1), "L"), ((0, 2), "L"), ((0, 128), "L"), ((0, 1), "I;16"), ((0, 255), "I;16"), ((0, 65535), "I;16")],
)
def test_the_only_value_besides_0_means_use_or_ignore(values: tuple[int, int], mode: str, folder: Path) -> None:
    pixels = np.full((32, 64), values[1], np.uint16 if mode == "I;16" else np.uint8)
    pixels[:16] = 0
    Image.fromarray(pixels).save(folder / "mask.png")
    marked = torch.zeros(32, 64)
    marked[16:] = 1
    torch.testing.assert_close(load(folder).train[0].mask(), marked)
    torch.testing.assert_close(load(folder, mask="inverted").train[0].mask(), 1 - marked)


@pytest.mark.parametrize("kind", ["ramp", "noise", "steps", "jpeg"])
def test_soft_edges_and_weights_are_masks(kind: str, folder: Path) -> None:
    row = np.linspace(0, 255, 64).astype(np.uint8)
    random = np.random.default_rng(0).integers(1, 250, (32, 64)).astype(np.uint8)
    steps = np.repeat(np.array([0, 85, 170, 255], np.uint8), 16)
    pixels = {"ramp": np.tile(row, (32, 1)), "noise": random, "steps": np.tile(steps, (32, 1))}
    pixels["jpeg"] = np.where(np.hypot(*np.mgrid[-16:16, -32:32]) < 20, np.uint8(0), np.uint8(255))
    file = folder / ("mask.jpg" if kind == "jpeg" else "mask.png")
    Image.fromarray(pixels[kind]).save(file, quality=30)
    assert load(folder).train[0].mask() is not None


def test_masks_that_are_not_used_are_named(folder: Path) -> None:
    for name in ("masks", "mask"):
        (folder / name).mkdir()
    for file in ("masks/pano_00.png", "masks/pano_01_person.png", "mask/pano_00.png"):
        _mask(folder / file)
    (note,) = (note for note in load(folder).notes if note.startswith("masks: "))
    assert note == "masks: masks/ for 1 of 6 views; not used: pano_01_person.png, mask/"


@pytest.mark.parametrize("spec", ["auto", "inverted"])
def test_labels_and_colours_are_no_masks(spec: str, folder: Path) -> None:
    _mask(folder / "mask.png")
    labels = np.array(Image.open(folder / "mask.png")) // 255 + 1
    labels[:4] = 0
    Image.fromarray(labels).save(folder / "mask.png")
    with pytest.raises(DataError, match=r"mask.png has no value above 2, as images of labels have; .* convert it"):
        load(folder, mask=spec)
    red = np.full((32, 64, 3), 255, np.uint8)
    red[24:] = (255, 0, 0)
    Image.fromarray(red).save(folder / "mask.png")
    with pytest.raises(DataError, match=r"mask.png is a mask in colours; a mask is white \(use\) and black"):
        load(folder, mask=spec)
    Image.fromarray(red).convert("L").convert("RGB").save(folder / "mask.jpg", quality=40)  # grey after JPEG
    (folder / "mask.png").unlink()
    assert load(folder).train[0].mask() is not None


def test_masks_may_be_smaller_than_images_but_not_than_views(folder: Path) -> None:
    Image.fromarray(np.repeat([255, 0], (12, 4)).astype(np.uint8)[:, None].repeat(32, 1)).save(folder / "mask.png")
    mask = load(folder, width=16).train[0].mask()
    assert mask is not None and mask.shape == (8, 16) and mask[:6].eq(1).all() and mask[6:].eq(0).all()
    with pytest.raises(DataError, match=r"mask.png is 32x16 .* no smaller than the view \(64x32, data.width\)"):
        load(folder)


def test_masks_of_whole_images_fit_reduced_ones(world: World, tmp_path: Path) -> None:
    write_transforms(world, tmp_path)
    data = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "images_2/images").mkdir(parents=True)
    for frame in data["frames"]:
        name = Path(frame["file_path"])
        Image.open(tmp_path / name).resize((32, 16)).save(tmp_path / "images_2" / "images" / name.name)
        frame["mask_path"] = f"masks/{name.name}"
        _mask(tmp_path / frame["mask_path"])
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    mask = load(tmp_path, images="images_2").train[0].mask()
    assert mask is not None and mask.shape == (16, 32) and mask[:12].eq(1).all() and mask[12:].eq(0).all()


@pytest.mark.parametrize("ids", [(33, 35), (1, 62, 171, 187, 190), (0, 7, 11, 23, 255), (1, 150)])
def test_areas_of_labels_are_no_masks(ids: tuple[int, ...], folder: Path) -> None:
    areas = np.repeat(np.array(ids, np.uint8), 13)[:64]
    Image.fromarray(np.tile(np.pad(areas, (0, 64 - len(areas)), "edge"), (32, 1))).save(folder / "mask.png")
    if ids == (0, 7, 11, 23, 255):  # three greys beside black and white may be weights
        assert load(folder, mask="mask.png").train[0].mask() is not None
        return
    with pytest.raises(
        DataError, match=rf"mask.png has areas of {ids[0]}, {ids[1]}.*, as images of labels have; .* 255"
    ):
        load(folder)
