"""`padgs export`: from a run to a file and back; transforms of Gaussians."""

import math
import re
import shutil
from dataclasses import replace

import pytest
import torch
from plyfile import PlyData
from scipy.spatial.transform import Rotation
from support.splat_cases import random_splats
from support.tiny_run import tiny_run
from support.tiny_scene import tiny_scene
from typer.testing import CliRunner

import padgs
from padgs.apps.export import explicit
from padgs.apps.export.explicit import UNSMOOTHED, UP, export_run, harmonics_rotation, transform_splats
from padgs.apps.export.splat_file import read_splats
from padgs.apps.external import open_model
from padgs.cli.commands import app
from padgs.evaluation.evaluate import evaluate
from padgs.evaluation.protocols import PROTOCOLS
from padgs.geometry import harmonics
from padgs.geometry.similarity import Similarity
from padgs.render import RenderOptions, render

RULES = replace(PROTOCOLS["sphere"], lpips="none", metrics=("ws_psnr",))


def export(*arguments: str):
    return CliRunner().invoke(app, ["export", *arguments])


@pytest.fixture(scope="module")
def splat_run(tmp_path_factory):
    """A run whose Gaussians are written as trained."""
    return tiny_run(tmp_path_factory, "method=padgs_plus", "render.steepness=0")


@pytest.fixture(scope="module")
def steep_run(tmp_path_factory):
    """A run whose kernel is no Gaussian."""
    return tiny_run(tmp_path_factory, "method=padgs_plus", "data.generator.width=64", "train.iterations=60")


def test_an_exported_run_scores_like_the_run(splat_run):
    result = export(str(splat_run))
    assert result.exit_code == 0 and "Gaussians as trained" in result.output
    run = padgs.load_run(splat_run)
    splats = read_splats(splat_run / "splats.ply", unit=run.scene.scale)
    options = run.method.model.render_options(run.scene.test[0])
    again = evaluate(lambda view: render(splats.gaussians(view), view, options), run.scene.test, RULES)
    plain = run.method.model.splats
    same = evaluate(lambda view: render(plain.gaussians(view), view, options), run.scene.test, RULES)
    own = evaluate(run.method.render, run.scene.test, RULES)
    assert again.metrics["ws_psnr"] == pytest.approx(same.metrics["ws_psnr"], abs=1e-6)
    assert again.metrics["ws_psnr"] == pytest.approx(own.metrics["ws_psnr"], abs=0.05)  # a file knows no cameras
    (splat_run / "splats.ply").unlink()


def test_a_steeper_kernel_is_exported_as_gaussians_of_equal_area_and_fitted(steep_run, tmp_path):
    run = padgs.load_run(steep_run, device="cpu")
    s, own = run.config.render.steepness, run.method.model.splats
    plain, fitted = (export_run(run, distillation_steps=steps) for steps in (0, 40))
    q = torch.linspace(0, 60, 600_001, dtype=torch.float64)
    area = torch.trapezoid(torch.exp(-0.5 * (q * (1 - s) + s * q * q)), q) / 2  # 1 for a Gaussian
    assert s == 0.25 and area.item() == pytest.approx(0.7526, abs=1e-4)
    moved = plain.splats.log_scales - own.log_scales
    torch.testing.assert_close(moved, (0.5 * area.log()).float().expand_as(moved), rtol=1e-4, atol=1e-6)
    assert torch.equal(plain.splats.means, own.means) and not torch.equal(fitted.splats.means, own.means)
    apart = [float(re.search(r"dB, ([\d.]+) dB ", " ".join(found.notes))[1]) for found in (plain, fitted)]
    assert apart[1] < 0.5 * apart[0], "renders of the run are fitted, not photographs"
    assert "Gaussians for a kernel of steepness 0.25; WS-PSNR of the test views" in " ".join(fitted.notes)
    assert "changes nothing" not in " ".join(plain.notes)
    gone = export(str(steep_run), "--data", str(tmp_path / "gone"), "--to", str(tmp_path / "a.ply"))
    assert gone.exit_code == 0 and "Gaussians of equal area" in gone.output


def test_gaussians_are_exported_without_the_data_set(splat_run, tmp_path):
    result = export(str(splat_run), "--data", str(tmp_path / "gone"), "--to", str(tmp_path / "a.ply"))
    assert result.exit_code == 0 and "the data set is missing" in result.output
    assert len(read_splats(tmp_path / "a.ply")) == len(padgs.load_run(splat_run).method.model.splats)


def test_a_method_without_a_3d_filter_says_that_smoothing_changes_nothing(tmp_path_factory):
    run = padgs.load_run(tiny_run(tmp_path_factory, "method=omnigs", "train.iterations=2"), device="cpu")
    plain, smooth = (export_run(run, smooth=wanted) for wanted in (False, True))
    assert torch.equal(plain.splats.log_scales, smooth.splats.log_scales)
    assert [note for note in smooth.notes if note not in plain.notes] == [UNSMOOTHED]


def test_smooth_includes_the_3d_smoothing_filter(splat_run, tmp_path):
    result = export(str(splat_run), "--smooth", "--distillation-steps", "5", "--to", str(tmp_path / "smooth.ply"))
    said = " ".join(result.output.split())
    assert result.exit_code == 0 and said.count("Gaussians as trained, including the 3D smoothing filter") == 1
    assert said.count("Gaussians as trained") == 1 and "--distillation-steps changes nothing" in said
    run = padgs.load_run(splat_run)
    view, options = run.scene.train[0], run.config.render.options(run.scene.scale)
    exact, smooth = (export_run(run, smooth=wanted).splats for wanted in (False, True))
    written = read_splats(tmp_path / "smooth.ply", unit=run.scene.scale)
    assert torch.allclose(written.log_scales, smooth.log_scales, atol=1e-5)
    without_filter = replace(options, low_pass=0.0, supersampling=1)  # as other viewers draw
    drawn = run.method.model.render(view).image
    errors = [
        (render(splats.gaussians(view), view, without_filter).image - drawn).abs().mean() for splats in (exact, smooth)
    ]
    assert errors[1] < 0.5 * errors[0], "without the filter the smooth ones look more like the run"


def test_refined_poses_are_aligned_with_the_scene(tmp_path_factory):
    run = padgs.load_run(tiny_run(tmp_path_factory, "method=sc_omnigs", "data.generator.train_views=4"))
    poses = run.method._poses
    with torch.no_grad():
        for correction in poses.parameters():
            correction += 0.02 * torch.randn(correction.shape, generator=torch.Generator().manual_seed(1))
    splats, view = export_run(run).splats, run.scene.test[0]
    mapped_view = view.at(run.method.world.pose(view.cam_from_world))
    options = run.config.render.options(run.scene.scale)
    own = run.method.model.render(mapped_view).image
    assert torch.allclose(render(splats.gaussians(view), view, options).image, own, atol=0.02)
    assert (run.method.model.render(view).image - own).abs().max() > 0.05, "it is another world"


def test_a_box_is_cropped(splat_run, tmp_path):
    run = padgs.load_run(splat_run)
    means = run.method.model.splats.means.detach()
    middle = means[:, 0].median().item()
    result = export(str(splat_run), "--crop", f"{middle} -99 -99 99,99,99", "--to", str(tmp_path / "c.ply"))
    assert result.exit_code == 0 and "cropped to" in result.output, result.output
    assert len(read_splats(tmp_path / "c.ply")) == int((means[:, 0] >= middle).sum()) < len(means)
    for box, message in (
        ("1 2", "must be six numbers"),
        ("0 0 0 1 1 -1", "must be six"),
        ("8 8 8 9 9 9", "no Gaussian lies in the box from [8.0, 8.0, 8.0] to [9.0, 9.0, 9.0]; they are from ["),
    ):
        result = export(str(splat_run), "--crop", box, "--to", str(tmp_path / "d.ply"))
        assert result.exit_code == 1 and message in result.output + result.stderr


def test_an_empty_box_is_found_before_the_long_work(tmp_path_factory, monkeypatch):
    run = padgs.load_run(tiny_run(tmp_path_factory, "method=padgs_small", "train.iterations=2"))
    monkeypatch.setattr(explicit, "bake", lambda *_: pytest.fail("baked"))
    with pytest.raises(ValueError, match="no Gaussian lies in the box"):
        explicit.export_run(run, crop=(800, 0, 0, 900, 1, 1))


def test_smoothing_that_nobody_asked_for_needs_no_note(tmp_path_factory, tmp_path, monkeypatch):
    run = tiny_run(tmp_path_factory, "method=omnigs", "train.iterations=2")
    monkeypatch.setattr("padgs.apps.export.splat_file.check_suffix", lambda path: None)
    monkeypatch.setattr("padgs.apps.export.splat_file.write_splats", lambda path, *_, **__: path.write_text(""))
    for options, shown in (((), False), (("--smooth",), True)):
        result = export(str(run), "--to", str(tmp_path / "a.html"), *options)
        assert result.exit_code == 0 and ("--smooth changes nothing" in result.output) == shown, result.output


def test_upright_worlds(splat_run, tmp_path):
    assert export(str(splat_run), "--upright", "--to", str(tmp_path / "new" / "u.ply")).exit_code == 0
    assert any("-y is up" in line for line in PlyData.read(str(tmp_path / "new" / "u.ply"))["vertex"].comments)
    up, plain = read_splats(tmp_path / "new" / "u.ply").means, padgs.load_run(splat_run).method.model.splats.means
    assert torch.allclose(-up[:, 1], plain[:, 2], atol=1e-4), "z is up in the built-in room"


def test_anchors_are_baked_and_the_loss_is_reported(tmp_path_factory, tmp_path):
    folder = tiny_run(tmp_path_factory, "method=padgs_small", "train.iterations=60")
    result = export(str(folder), "--to", str(tmp_path / "a.ply"), "--distillation-steps", "40")
    assert result.exit_code == 0, result.output
    (line,) = [line for line in PlyData.read(str(tmp_path / "a.ply"))["vertex"].comments if line.startswith("baked")]
    assert line in result.output and "WS-PSNR of the test views" in line
    assert len(read_splats(tmp_path / "a.ply")) > 0


def test_the_export_of_a_run_that_trains_says_of_which_iteration_it_is(splat_run, tmp_path):
    copy = shutil.copytree(splat_run, tmp_path / "run")
    (copy / "result.json").unlink()
    for folder, count in ((copy, 1), (splat_run, 0)):
        result = export(str(folder), "--to", str(tmp_path / "a.ply"))
        said = " ".join(result.output.split())
        assert result.exit_code == 0 and said.count("the run has not ended; its model is that of iteration 30") == count


def test_files_that_cannot_state_an_axis_are_upright(splat_run, tmp_path, monkeypatch):
    means = {}
    monkeypatch.setattr("padgs.apps.export.splat_file.check_suffix", lambda path: None)
    monkeypatch.setattr(
        "padgs.apps.export.splat_file.write_splats",
        lambda path, splats, *_, **__: path.write_text("") or means.update({path.name: splats.means.detach()}),
    )
    names = ["a.compressed.ply", "a.spz", "a.SOG", "a.glb", "a.html", "a.ply"]
    for name in names:
        assert export(str(splat_run), "--to", str(tmp_path / name), "--device", "cpu").exit_code == 0
    for name in names[:-1]:
        assert torch.allclose(-means[name][:, 1], means["a.ply"][:, 2], atol=1e-4), "z is up in the built-in room"


def test_the_file_says_which_axis_is_up_for_viewers_of_it_alone(splat_run, tmp_path):
    up = (UP, (0.0, 0.0, 1.0))
    for upright in (True, False):
        options = ("--upright", "--to") if upright else ("--to",)
        assert export(str(splat_run), *options, str(tmp_path / "a.ply")).exit_code == 0
        comments = PlyData.read(str(tmp_path / "a.ply"))["vertex"].comments
        assert ("Vertical Axis: z" in comments) != upright
        (view,) = open_model(str(tmp_path / "a.ply"), device="cpu").scene.train
        assert (-view.cam_from_world[1, :3]).tolist() == pytest.approx(up[not upright], abs=1e-9), "y is down"


@pytest.mark.parametrize("camera", ["train.poses=learned_fast", "train.lens=map"])
def test_anchors_of_a_learned_camera_are_baked_in_the_given_world(camera, tmp_path_factory, monkeypatch):
    run, given = padgs.load_run(tiny_run(tmp_path_factory, "method=padgs_small", "train.iterations=2", camera)), []
    with torch.no_grad():
        for shift in () if run.method.world is None else run.method._poses.shifts:
            shift += torch.tensor([0.3, 0.0, 0.0])
    world = run.method.world or Similarity()
    monkeypatch.setattr(explicit, "distill", lambda splats, teacher, scene, *_: given.extend((teacher, scene.train[0])))
    splats = export_run(run).splats
    centers = world.inverse()(run.method.model.anchors.centers().double())
    assert torch.cdist(splats.means.double(), centers).amin(1).max() < 1e-5
    teacher, view = given
    assert teacher == run.method.model.render, "ideal renders"
    assert torch.equal(view.cam_from_world, world.pose(run.scene.train[0].cam_from_world))


def test_methods_without_gaussians_are_refused(tmp_path_factory, tmp_path, splat_run):
    folder = tiny_run(tmp_path_factory, "method=egonerf_small", "train.iterations=2")
    (tmp_path / "file").touch()
    for arguments, message in (
        ((str(folder),), "egonerf has no Gaussians to export; use padgs render or padgs view"),
        ((str(tmp_path / "RUNX"),), "has no config.yaml"),
        ((str(splat_run), "--to", "a.obj"), "has an unknown format"),
        ((str(splat_run), "--to", str(tmp_path / "file" / "a.ply")), "name another place with --to"),
        ((str(splat_run), "--upright", "--to", str(tmp_path / "a.ply"), "--data", "gone"), f"data of {splat_run}"),
    ):
        result = export(*arguments)
        assert result.exit_code == 1 and message in result.output + result.stderr
    assert not (tmp_path / "RUNX").exists(), "a name that was misspelt"


def test_moved_gaussians_look_the_same_from_moved_cameras(generator):
    splats = random_splats(3, generator)
    splats.log_scales.data -= 1.5
    rotation = torch.from_numpy(Rotation.from_rotvec([0.5, -1.2, 0.3]).as_matrix())
    similarity = Similarity(1.7, rotation, torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64))
    view = tiny_scene().train[3]
    pose = view.cam_from_world.clone()
    pose[:3, :3] = view.cam_from_world[:3, :3] @ rotation.T
    pose[:3, 3] = -pose[:3, :3] @ similarity(view.center)
    before = render(splats.gaussians(view), view, RenderOptions())
    new = transform_splats(splats, similarity)
    after = render(new.gaussians(view.at(pose)), view.at(pose), RenderOptions())
    assert torch.allclose(after.image, before.image, atol=2e-3) and before.image.std() > 0.1
    assert math.isclose(new.scene_scale, 1.7 * splats.scene_scale)
    back = transform_splats(new, similarity.inverse())
    for name in ("means", "log_scales", "sh_dc", "sh_rest"):
        assert torch.allclose(back.rows()[name], splats.rows()[name], atol=1e-4), name


def test_turned_harmonics_are_the_function_turned(generator):
    rotation = torch.from_numpy(Rotation.random(random_state=3).as_matrix())
    directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator, dtype=torch.float64), dim=-1)
    coefficients = torch.randn(16, generator=generator, dtype=torch.float64)
    before = harmonics.basis(directions, 3) @ coefficients
    after = harmonics.basis(directions @ rotation.T, 3) @ harmonics_rotation(rotation, 3) @ coefficients
    assert torch.allclose(after, before, atol=1e-9)


def test_a_direction_is_turned_to_another_even_its_opposite():
    for up in ([0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 1.0, 0.0]):
        rotated = Similarity.turning(torch.tensor(up), UP)(torch.tensor(up, dtype=torch.float64))
        assert torch.allclose(rotated, torch.tensor(UP, dtype=torch.float64), atol=1e-6)
