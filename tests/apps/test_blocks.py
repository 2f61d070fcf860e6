"""A capture of two rooms as two blocks, trained one by one and merged."""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console
from typer.testing import CliRunner

import padgs.data
from padgs import results
from padgs.apps import block_plan, blocks
from padgs.apps.block_plan import bisect
from padgs.apps.blocks import BLOCK, REGIONS, merge
from padgs.cli.commands import app
from padgs.data.assemble import assemble
from padgs.data.capture import Capture, Cloud, DataOptions, Frame, Tracks
from padgs.data.formats.transforms import REDUCED
from padgs.data.formats.writers import Content, write_transforms
from padgs.data.images import save_png
from padgs.multirun.composition import composing, configuration
from padgs.multirun.overrides import quoted
from padgs.runs.run import run
from padgs.scene import View

TRAINING = ["train.iterations=20", "protocol=sphere", "protocol.sphere.lpips=none", "run.device=cpu", "tracking=none"]


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """Two rooms with a door between them, as a folder."""
    folder, frames = tmp_path_factory.mktemp("data") / "rooms", []
    generator = {"scene": "room_chain", "width": 32, "train_views": 16, "test_views": 4, "samples": 1, "points": 4000}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PADGS_CACHE", str(tmp_path_factory.getbasetemp() / "scenes"))
        scene = padgs.data.load(generator=generator)
    for side in ("train", "test"):
        for view in getattr(scene, side):
            frames.append(Frame(f"{side}{view.name}.png", folder, view.cam_from_world, 32, 16))
            save_png(view.load_pixels(), folder / "images" / frames[-1].name)
    names = {side: tuple(f.name for f in frames if f.name.startswith(side)) for side in ("train", "test")}
    write_transforms(Content(tuple(frames), Cloud(scene.points.double(), scene.point_colors), None, names), folder)
    return folder


@pytest.fixture(scope="module")
def parts(source) -> list[Path]:
    """The folders of two blocks."""
    done = CliRunner().invoke(app, ["split", str(source), "--blocks", "2"])
    assert done.exit_code == 0 and "next: padgs-run -m data.path=" in done.output, done.output
    return sorted(source.with_name("rooms-blocks").glob("rooms-block-*"))


def trained(folder: Path, runs: Path, *settings: str) -> str:
    with composing():
        config = configuration([f"data.path={folder}", "method=omnigs", *TRAINING, *settings, f"run.folder={runs}"])
    return str(runs / run(config, Console(quiet=True)).run)


@pytest.fixture(scope="module")
def runs(parts, tmp_path_factory) -> list[str]:
    folder = tmp_path_factory.mktemp("runs")
    return [trained(part, folder, "method.length_unit=nearest_camera") for part in parts]


@pytest.mark.parametrize("sizes", [(5, 5), (4, 6, 5), (9, 9, 9, 9, 9)])
def test_groups_that_share_little_are_clusters(sizes):
    label = np.repeat(np.arange(len(sizes)), sizes)
    neighbours = np.abs(label[:, None] - label) == 1
    affinity = np.where(label[:, None] == label, 1.0, np.where(neighbours, 0.05, 1e-6))
    shuffled = np.random.default_rng(0).permutation(len(label))
    found = bisect(affinity[np.ix_(shuffled, shuffled)], np.arange(len(label)), len(sizes))
    assert sorted(sorted(label[shuffled[part]].tolist()) for part in found) == [
        [k] * size for k, size in enumerate(sizes)
    ]


def test_few_nodes_are_divided_however_they_hang_together():
    random = np.random.default_rng(0)
    for size in range(2, 13):
        for count in range(1, size // 2 + 1):
            shared = random.random((size, size)) ** 8 + 1e-6
            found = bisect(shared + shared.T, np.arange(size), count)
            assert len(found) == count and sorted(np.concatenate(found).tolist()) == [*range(size)]


def test_tracks_say_what_a_camera_sees():
    frames = tuple(Frame(f"{name}.png", Path(), torch.eye(4)) for name in "ab")
    tracks = Tracks(torch.tensor([0, 1, 1]), torch.tensor([2, 0, 1]), torch.zeros(3, 2))
    capture = Capture("colmap", Path(), Path(), frames, None, tracks=lambda: tracks)
    views = [View(name, torch.eye(4), 8, 4) for name in "ba"]
    assert block_plan.visibility(capture, views, torch.zeros(3, 3)).tolist() == [
        [True, True, False],
        [False, False, True],
    ]


def test_a_block_is_a_room_with_the_views_that_see_into_it(source, parts):
    whole, loaded = padgs.data.load(source), [padgs.data.load(part) for part in parts]
    capture = padgs.data.read(source)
    plan = block_plan.plan(capture, assemble(capture, DataOptions()), 2)
    for core, margin, held, scene, part in zip(plan.core, plan.margin, plan.held, loaded, parts, strict=True):
        sides = {float(view.center[0]) > 0 for view in core}
        assert len(core) == 8 and len(sides) == 1
        near = [abs(float(view.center[0])) for view in margin]
        assert 2 <= len(margin) <= 6 and max(near) < 2.5, "those near the door"
        shares = {view.name: view.share for view in scene.train}
        assert shares == pytest.approx({name: block_plan.sphere_share(part) for name, part in held.items()}, abs=1e-4)
        for view in scene.train:
            mask = view.mask()
            assert mask is not None and abs(mask.mean() - held[view.name].mean()) < 0.05
        assert min(shares[view.name] for view in core) > 0.5 > max(shares[view.name] for view in margin) - 0.2
        assert len(scene.points) < 0.9 * len(whole.points)
        assert all(path.is_symlink() for path in (part / "images").iterdir())
    alone = block_plan.plan(capture, assemble(capture, DataOptions(split="all")), 2)
    assert alone.test == [[], []] and sum(map(len, alone.core)) == 20
    tests = [view.name for scene in loaded for view in scene.test]
    assert sorted(tests) == sorted(view.name for view in whole.test)


def test_blocks_of_a_format_that_reduces_wide_images_are_reduced(source, tmp_path):
    folder = shutil.copytree(source, tmp_path / "rooms")
    described = json.loads((folder / "transforms.json").read_text())
    for frame in described["frames"]:
        del frame["w"], frame["h"]
    (folder / "transforms.json").write_text(json.dumps(described | {REDUCED: 16}))
    done = CliRunner().invoke(app, ["split", str(folder), "--blocks", "2", "--to", str(tmp_path / "two, rooms")])
    assert done.exit_code == 0, done.output
    command = shlex.split(done.output.partition("next: ")[2].partition(", then")[0])
    *_, paths = quoted(command)
    assert [*map(str.strip, paths.split('"')[1::2])] == [
        str(tmp_path / "two, rooms" / f"rooms-block-{n}") for n in (1, 2)
    ]
    for part in (tmp_path / "two, rooms").glob("rooms-block-*"):
        scene = padgs.data.load(part)
        assert all(view.width == 16 and view.mask().shape == (8, 16) for view in scene.train)
        assert "used as they are" not in " ".join(scene.notes)


def test_blocks_below_a_linked_folder_have_their_images_and_depth_maps(source, tmp_path):
    real = tmp_path / "disk" / "deep"
    shutil.copytree(source, real / "rooms")
    (tmp_path / "data").symlink_to(real)
    (real / "rooms" / "depths").mkdir()
    for image in (real / "rooms" / "images").iterdir():
        np.save(real / "rooms" / "depths" / f"{image.stem}.npy", np.ones((16, 32), np.float32))
    (real / "rooms" / "depths" / "depth.json").write_text('{"measure": "ray"}')
    done = CliRunner().invoke(app, ["split", str(tmp_path / "data" / "rooms"), "--blocks", "2"])
    assert done.exit_code == 0, done.output
    links = [*(real / "rooms-blocks").glob("*/images/*")]
    assert links and all(link.is_symlink() and link.is_file() for link in links)
    for part in (real / "rooms-blocks").glob("rooms-block-*"):
        assert all(view.load_depth is not None for view in padgs.data.load(part).train)


def test_a_merged_model_has_of_each_run_what_lies_in_its_block(source, runs, capsys):
    path = merge(runs, Console(width=200))
    assert (
        f"padgs-run data.path={source} data.cameras=panoramas init={path} train.refine=true" in capsys.readouterr().out
    )
    merged, loaded = padgs.load_run(path, device="cpu"), [padgs.load_run(one, device="cpu") for one in runs]
    assert merged.result.ok and merged.result.variant == "2 blocks, continued"
    assert merged.config.data.path == str(source) and merged.config.data.cameras == "panoramas"
    assert len(merged.scene.test) == 4 and merged.score("sphere").metrics == merged.scores["sphere"].metrics
    assert merged.result.timing["cpu_seconds"] == sum(one.result.timing["cpu_seconds"] for one in loaded)
    means = merged.method.model.splats.means
    count = 0
    for one in loaded:
        own = one.method.model.splats.means
        kept = (own[:, None] == means).all(-1).any(-1)
        side = float(np.median([float(view.center[0]) for view in one.scene.train])) > 0
        x = own[:, 0]
        assert kept[(x > 0.3) == side][x[(x > 0.3) == side].abs() > 0.3].float().mean() > 0.95
        count += int(kept.sum())
    assert count == len(means) == len(merged.method.model.groups()[0].row_rates())
    before = (path / "result.json").stat().st_mtime_ns
    assert merge(runs[::-1], Console(quiet=True)) == path, "in any order"
    assert (path / "result.json").stat().st_mtime_ns == before, "finished runs are kept"


def test_blocks_that_were_trained_differently_are_joined_with_a_note(parts, runs, tmp_path, capsys):
    """Also one that was trained by the file in it, and from another folder after both blocks have moved."""
    other = trained(parts[1] / "transforms.json", tmp_path, "seed=3", "method.length_unit=nearest_camera")
    path = merge([runs[0], other], Console(width=400))
    assert "trained differently: seed; the merged run states those of" in capsys.readouterr().out
    assert padgs.load_run(path, device="cpu").result.variant == "2 blocks mixed, continued"
    moved = shutil.copytree(parts[0].parent, tmp_path / "moved" / "rooms-blocks", symlinks=True)
    shutil.copytree(parts[0].parent.with_name("rooms"), tmp_path / "moved" / "rooms")
    shutil.rmtree(path)
    path = merge([runs[0], other], Console(quiet=True), data=str(moved))
    assert padgs.load_run(path, device="cpu").config.data.path == str(tmp_path / "moved" / "rooms")


def test_a_merged_run_has_the_preset_of_its_blocks_and_stands_beside_them(runs, tmp_path, monkeypatch):
    copies = [Path(shutil.copytree(run, tmp_path / "moved" / Path(run).name)) for run in runs]
    for copy in copies:
        found = results.read(copy / "result.json")
        results.write(replace(found, preset="omnigs_release", machine={**found.machine, "gpu": "A100"}), copy)
    monkeypatch.chdir(tmp_path)
    path = merge([str(copy.relative_to(tmp_path)) for copy in copies], Console(quiet=True))
    merged = padgs.load_run(path, device="cpu").result
    assert path.parent == tmp_path / "moved" and merged.preset == "omnigs_release"
    assert merged.machine["cpu"].startswith("A100 then ") and "cpu_seconds" not in merged.timing


def test_the_source_is_found_through_links(source, tmp_path, monkeypatch):
    """Blocks below a link, trained by their real place; `merge` finds the source and a mask named from elsewhere."""
    real = tmp_path / "disk" / "deep"
    shutil.copytree(source, tmp_path / "rooms")
    real.mkdir(parents=True)
    (tmp_path / "link").symlink_to(real)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    Image.new("L", (32, 16), 255).save("elsewhere/all.png")
    shutil.move("rooms/sparse_pc.ply", "elsewhere/lidar.ply")
    settings = ["--blocks", "2", "--to", "link/parts", "--mask", "elsewhere/all.png", "--points", "elsewhere/lidar.ply"]
    done = CliRunner().invoke(app, ["split", "rooms", *settings])
    assert done.exit_code == 0, done.output
    runs = [trained(real / "parts" / f"rooms-block-{number}", tmp_path / "runs") for number in (1, 2)]
    monkeypatch.chdir(source)
    merged = padgs.load_run(merge(runs, Console(quiet=True)), device="cpu")
    assert merged.config.data.path == str(tmp_path / "rooms")
    assert all(view.mask() is not None for view in merged.scene.train)


def test_what_cannot_be_merged_is_refused(source, parts, runs, tmp_path):
    def error(*folders: str) -> str:
        done = CliRunner().invoke(app, ["merge", *folders])
        assert done.exit_code == 1 and done.output.startswith("error: "), done.output
        return done.output

    assert "block 2 of 2 has no run; give one run of each block" in error(runs[0])
    assert "block 1 of 2 has several runs" in error(*runs, runs[0])
    assert "whose parts share parameters" in error(trained(parts[0], tmp_path, "method=padgs"), runs[1])
    assert "has other settings of method" in error(runs[0], trained(parts[1], tmp_path, "method.sh_degree=1"))
    assert "name the folder of the blocks with --data" in error(trained(source, tmp_path), runs[1])
    every = trained(parts[1], tmp_path, "data.split=every", "data.test_every=4")
    assert "has data.split=every, with other test views than the whole" in error(runs[0], every)
    whole = [trained(part, tmp_path, "data.split=all") for part in parts]
    assert "has data.split=all, with other test views" in error(runs[0], whole[1])
    merged = padgs.load_run(merge(whole, Console(quiet=True)), device="cpu")
    assert not merged.scene.test and not merged.result.scores, "all views were trained on"
    split = (source / "transforms.json").read_text()
    leaking = json.loads(split)
    leaking["test_filenames"], leaking["train_filenames"] = (
        leaking["train_filenames"][:4],
        leaking["train_filenames"][4:],
    )
    (source / "transforms.json").write_text(json.dumps(leaking))
    assert "blocks were trained on test views of rooms" in error(*runs)
    (source / "transforms.json").write_text(split)
    text = (described := parts[0] / BLOCK).read_text()
    damages = {"": "block.json is empty", "{": "is not valid JSON", "[1]": "must be an object", "{}": "lacks the field"}
    for damage, words in damages.items():
        described.write_text(damage)
        assert words in error(*runs) and "block.json" in error(*runs)
    described.write_text(text)
    (kept := parts[0].parent / REGIONS).rename(kept.with_name("moved"))
    assert "regions.npz is missing, or not that of" in error(*runs) and "split the data set again" in error(*runs)
    kept.with_name("moved").rename(kept)
    copy = shutil.copytree(runs[0], tmp_path / "copy")
    results.write(replace(results.read(copy / "result.json"), status="nan", reason="x"), copy)
    assert "did not end well" in error(str(copy), runs[1])


def test_blocks_are_beside_the_working_folder_too(tmp_path, monkeypatch):
    (tmp_path / "capture").mkdir()
    monkeypatch.chdir(tmp_path / "capture")
    monkeypatch.setattr(blocks, "split", lambda source, destination, *_: ({destination: ""}, ()))
    done = CliRunner().invoke(app, ["split", ".", "--blocks", "2"])
    assert str(tmp_path / "capture-blocks") in done.output.replace("\n", "")


def test_words_are_no_folders_and_links_lead_to_the_disk_meant(source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("auto", "disk"):
        (tmp_path / name).mkdir()
    people = np.zeros((16, 32), np.uint8)
    people[12:] = 255
    Image.fromarray(people).save(tmp_path / "people.png")
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "blocks")
    arguments = ["split", str(source), "--blocks", "2", "--mask", "inverted:people.png", "--to", "link"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    (block, _) = sorted((tmp_path / "disk" / "blocks").glob("rooms-block-*"))
    options = json.loads((block / BLOCK).read_text())["options"]
    assert (options["mask"], options["points"]) == (f"inverted:{tmp_path / 'people.png'}", "auto")


def test_what_cannot_be_split_is_refused_and_nothing_is_written(source, parts, tmp_path):
    for arguments, message in (
        (["--blocks", "9"], "--blocks is 9; 16 training views make 2 to 8 blocks"),
        (["--blocks", "1"], "--blocks is 1; it must be from 2"),
        (["--blocks", "2", "--to", str(parts[0])], "exists; nothing is overwritten"),
        (["--blocks", "2", "--to", "/proc/x"], "cannot write /proc/x"),
    ):
        done = CliRunner().invoke(app, ["split", str(source), "--to", str(tmp_path / "to"), *arguments])
        assert done.exit_code == 1 and message in done.output, done.output
    assert list(tmp_path.iterdir()) == []
