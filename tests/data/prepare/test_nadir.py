"""Nadir masks: position, angle, and refusal of existing masks."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.fixtures import World, write_colmap_text, write_images, write_transforms
from typer import Typer
from typer.testing import CliRunner

from padgs.cli.mask import mask
from padgs.data import DataError, load
from padgs.data.prepare.nadir import write_nadir_mask
from padgs.data.prepare.sources import find_source

app = Typer()
app.command()(mask)


@pytest.mark.parametrize("images", ["", "images"])
def test_prepare_uses_the_mask_and_ignores_the_preview(images: str, world: World, tmp_path: Path) -> None:
    write_images(world, tmp_path / "shoot" / images)
    done = CliRunner().invoke(app, [str(tmp_path / "shoot"), "--below", "45"])
    assert done.exit_code == 0 and "mask.png for 6 panoramas" in done.output, done.output
    source = find_source(tmp_path / "shoot", "auto")
    assert len(source.images) == 6
    weights = source.masks["pano_00.png"]()
    assert weights[:24].min() == 1 and weights[24:].max() == 0  # 45 of the 90 degrees below: a quarter of 32 rows
    with Image.open(tmp_path / "shoot" / "mask_preview.jpg") as preview:
        red, _, blue = np.asarray(preview, float)[26:].mean((0, 1))
        assert preview.size == (64, 32) and red > blue + 50


def test_load_uses_the_mask(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    write_nadir_mask(tmp_path, 60)
    use = load(tmp_path).train[0].mask()
    assert use is not None and use.mean() == pytest.approx(150 / 180, abs=0.01)


def test_per_image_masks_are_not_replaced(world: World, tmp_path: Path) -> None:
    write_transforms(world, tmp_path / "posed")
    meta = json.loads((tmp_path / "posed" / "transforms.json").read_text())
    meta["frames"][2]["mask_path"] = "hands/pano_02.png"
    (tmp_path / "posed" / "transforms.json").write_text(json.dumps(meta))
    with pytest.raises(
        DataError, match=r"transforms names masks of its own, such as .*pano_02.png, which take precedence over mask"
    ):
        write_nadir_mask(tmp_path / "posed", 60)
    write_images(world, tmp_path / "shoot")
    (tmp_path / "shoot" / "masks").mkdir()
    with pytest.raises(DataError, match=r"masks holds masks of single images, which mask.png would replace"):
        write_nadir_mask(tmp_path / "shoot", 60, overwrite=True)
    assert not list(tmp_path.rglob("mask.png"))


def test_existing_masks_and_invalid_input_are_refused(world: World, tmp_path: Path) -> None:
    write_images(world, tmp_path / "shoot")
    Image.fromarray(np.full((32, 64), 255, np.uint8)).save(tmp_path / "shoot" / "mask.png")
    with pytest.raises(DataError, match=r"mask.png exists; .* --overwrite"):
        write_nadir_mask(tmp_path / "shoot", 60)
    assert write_nadir_mask(tmp_path / "shoot", 60, overwrite=True).images == 6
    for below in (0, 90, float("nan")):
        with pytest.raises(DataError, match="degrees below the horizon"):
            write_nadir_mask(tmp_path / "shoot", below)
    with pytest.raises(DataError, match="absent is not a folder"):
        write_nadir_mask(tmp_path / "absent", 60)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="holds no images"):
        write_nadir_mask(tmp_path / "empty", 60)
    Image.fromarray(np.zeros((16, 32, 3), np.uint8)).save(tmp_path / "shoot" / "small.png")
    with pytest.raises(DataError, match=r"2 sizes \(32x16, 64x32\).* resize them"):
        write_nadir_mask(tmp_path / "shoot", 60, overwrite=True)
