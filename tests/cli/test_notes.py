"""Notes of commands name options, not the keys of a run, except those about training."""

from pathlib import Path

import pytest
from PIL import Image
from support.fixtures import World, make_world, write_colmap_text
from typer.testing import CliRunner

from padgs.cli.commands import app
from padgs.data.prepare.sources import find_source
from padgs.data.prepare.work import Prepared, PrepareOptions, digest_of, fingerprint


@pytest.fixture
def world() -> World:
    return make_world(width=16, points=40)


def masked(folder: Path) -> None:
    """Write a mask for all views, and a folder of masks that is not used beside it."""
    Image.new("L", (16, 8), 255).save(folder / "mask.png")
    (folder / "masks").mkdir()
    Image.new("L", (16, 8), 255).save(folder / "masks" / "pano_00.png")


def output(*arguments: object) -> list[str]:
    done = CliRunner().invoke(app, [*map(str, arguments)])
    assert done.exit_code == 0, done.output
    return [line.strip() for line in done.output.splitlines()]


def test_notes_of_convert(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap_text(world, tmp_path / "a")
    masked(tmp_path / "a")
    monkeypatch.chdir(tmp_path)
    lines = output("convert", "a", "b", "--to", "transforms", "--split", "all", "--points", "random")
    assert "mask: mask.png for every view; masks/ is not used (--mask masks uses it)" in lines
    assert "points: 100000 random points around the cameras (--points random)" in lines
    training = "split: no list states that every view is a training view; train on b with data.split=all"
    assert training in lines, "of training, which has no such options"


def test_notes_of_prepare(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The result is there already, so that nothing is computed."""
    write_colmap_text(world, tmp_path / "b")
    write_colmap_text(world, tmp_path / "a")
    masked(tmp_path / "a")
    monkeypatch.chdir(tmp_path)
    options, notes = PrepareOptions(), find_source(Path("a"), "auto").notes
    digest = digest_of(fingerprint(Path("a"), options), options)
    Prepared(tmp_path / "b", tuple(world.names), (), 40, 0, notes=notes).write(tmp_path / "b", options, digest)
    lines = output("prepare", "a", "b")
    assert lines[0] == "6 of 6 panoramas placed, 40 points"
    assert lines[1] == "mask: mask.png for every view; masks/ is not used (--mask masks uses it)"
