"""Photographs of other cameras beside panoramas: weights, rays, training and scores."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from padgs.data import DataError, load
from padgs.data.check import check
from padgs.data.formats.colmap_files import Camera
from padgs.data.formats.colmap_lens import fisheye_rays, lens_of, pycolmap_module
from padgs.data.synthetic import SyntheticOptions
from padgs.evaluation.evaluate import evaluate
from padgs.evaluation.protocols import PROTOCOLS
from padgs.geometry.camera import Panorama, RayTable, perspective, pixel_solid_angles, sphere_share
from padgs.multirun.composition import composing, configuration
from padgs.render import Rendering
from padgs.results import Result
from padgs.runs.run import run
from padgs.scene import View
from padgs.training.targets import weight_of
from tests.support import mixed_capture

OPTIONS = SyntheticOptions(width=64, train_views=6, test_views=2, samples=4, points=2000)
TEST = (2, 5)  # the views that the generator holds out


def test_a_cube_of_photographs_weighs_as_much_as_a_panorama() -> None:
    face, panorama = perspective(41, 41, 90.0), Panorama(128, 64)
    cube, sphere = 6 * pixel_solid_angles(face).sum().item(), pixel_solid_angles(panorama).sum().item()
    assert cube == pytest.approx(4 * math.pi, rel=0.01) and sphere == pytest.approx(4 * math.pi, rel=0.01)
    assert 6 * sphere_share(face) == pytest.approx(1, rel=0.01)
    tangent = math.tan(math.radians(30))
    assert sphere_share(perspective(60, 60, 60.0)) == pytest.approx(
        4 * math.asin(tangent**2 / (1 + tangent**2)) / (4 * math.pi), rel=1e-3
    )
    views = [View("", torch.eye(4), camera.width, camera.height, lens=camera) for camera in (face, panorama)]
    weights = [weight_of(view, "solid_angle").expand(view.height, view.width) for view in views]
    cube, sphere = (
        weight.double().sum().item() / camera.focal**2 for weight, camera in zip(weights, (face, panorama), strict=True)
    )
    assert 6 * cube == pytest.approx(sphere, rel=0.01)
    assert weight_of(views[0], "uniform").max() == weight_of(views[0], "end_rows").min() == 1


@pytest.mark.parametrize("k", [(), (0.05, -0.01), (-0.02, 0.01, 0.0, 0.001)])
def test_rays_of_fisheyes_beyond_90_degrees(k: tuple[float, ...]) -> None:
    random = np.random.default_rng(0)
    angle, around = random.uniform(0, math.radians(100), 50), random.uniform(0, 2 * math.pi, 50)
    rays = np.column_stack((np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)))
    radius = angle + sum(factor * angle ** (3 + 2 * power) for power, factor in enumerate(k))
    places = radius[:, None] * np.column_stack((np.cos(around), np.sin(around)))
    np.testing.assert_allclose(fisheye_rays(places, np.array(k)), rays, atol=1e-8)


def test_lenses_agree_with_colmap() -> None:
    cameras = {
        "SIMPLE_PINHOLE": (50, 30, 20),
        "PINHOLE": (50, 60, 30, 20),
        "OPENCV": (50, 60, 30, 20, 0.02, -0.01, 1e-3, 2e-3),
        "SIMPLE_RADIAL_FISHEYE": (50, 30, 20, 0.03),
        "OPENCV_FISHEYE": (50, 60, 30, 20, 0.05, -0.01, 0.0, 1e-3),
        "type 16": (50, 60, 30, 20, 0.5, 1.1),  # EUCM, in binary files
    }
    colmap = pycolmap_module()
    for name, params in cameras.items():
        lens = lens_of(Camera(name, 60, 40, params), "a.png", 30, 20)
        model = colmap.Camera(model=name.replace("type 16", "EUCM"), width=60, height=40, params=params)
        rows, columns = np.mgrid[:20, :30] * 2 + 1.0
        rays = model.cam_ray_from_img(np.stack((columns, rows), -1).reshape(-1, 2)).reshape(20, 30, 3)
        np.testing.assert_allclose(lens.rays().numpy(), rays, atol=1e-6, err_msg=name)
        assert isinstance(lens, RayTable) == ("PINHOLE" not in name)


@pytest.mark.parametrize(
    "camera",
    [
        Camera("FISH", 60, 40, (50,)),
        Camera("PINHOLE", 60, 40, (50, 50, 30)),
        Camera("PINHOLE", 60, 40, (-50, 50, 30, 20)),
        Camera("PINHOLE", 60, 40, (math.nan, 50, 30, 20)),
        Camera("OPENCV", 60, 40, (20, 20, 30, 20, -0.9, 0, 0, 0)),
        Camera("OPENCV_FISHEYE", 60, 40, (8, 8, 30, 20, -0.2, 0, 0, 0)),
    ],
)
def test_impossible_lenses_are_refused(camera: Camera) -> None:
    with pytest.raises(DataError, match=rf"a.png has a {camera.model} camera of 60x40 .* data.cameras=panoramas"):
        lens_of(camera, "a.png", 60, 40)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return captures of one scene, with equal test views: panoramas, and every second as a cube or two fisheyes."""
    folder = tmp_path_factory.mktemp("captures")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PADGS_CACHE", str(tmp_path_factory.getbasetemp() / "scenes"))
        for name in ("panorama", "face", "fisheye"):
            train = [i for i in range(8) if i not in TEST]
            kinds = {i: [name if number % 2 else "panorama"] for number, i in enumerate(train)}
            mixed_capture.write_mixed(folder / name, OPTIONS, kinds | {i: ["panorama"] for i in TEST})
            lines = [f"panorama/{i:03d}.png\n" for i in TEST]
            (folder / name / "test.txt").write_text("".join(lines))
    return folder


def trained(data: Path, runs: Path, *settings: str) -> Result:
    fixed = ["protocol=sphere", "protocol.sphere.lpips=none", "run.device=cpu", "tracking=none", f"run.folder={runs}"]
    with composing():
        config = configuration([f"data.path={data}", *fixed, *settings])
    return run(config, Console(quiet=True))


def test_photographs_are_read_with_their_cameras(captures: Path) -> None:
    scene = load(captures / "face")
    assert [view.camera.kind for view in scene.train] == ["panorama"] * 3 + ["pinhole"] * 18
    assert sum(view.sphere_share for view in scene.train) == pytest.approx(6, rel=0.01)
    half = load(captures / "face", width=32)
    assert {(view.width, view.height) for view in half.train} == {(32, 16), (10, 10)}
    fisheyes = load(captures / "fisheye")
    table = next(view.lens for view in fisheyes.train if view.lens is not None)
    focal = OPTIONS.width / (2 * math.pi)
    torch.testing.assert_close(table.rays(), mixed_capture.fisheye_rays(table.width, focal).float(), atol=1e-6, rtol=0)
    assert table.kind == "opencv_fisheye"
    alone = load(captures / "face", cameras="panoramas")
    assert len(alone.train) == 3 and "18 of 23 images are no panoramas; they are left out" in str(alone.notes)
    assert not any("no pose" in note for note in alone.notes)
    assert len({scene.fingerprint, half.fingerprint, fisheyes.fingerprint, alone.fingerprint}) == 4
    report = check(captures / "face")
    assert not report.problems and report.colour_correlation > 0.5


def test_captures_without_panoramas_are_refused(captures: Path, tmp_path: Path) -> None:
    (tmp_path / "images").symlink_to(captures / "face/images")
    (tmp_path / "sparse/0").mkdir(parents=True)
    for file in (captures / "face/sparse/0").iterdir():
        lines = file.read_text().splitlines(keepends=True)
        (tmp_path / "sparse/0" / file.name).write_text("".join(line for line in lines if "panorama/" not in line))
    with pytest.raises(DataError, match=r"all 18 images .* beside panoramas .*`padgs prepare`"):
        load(tmp_path)
    (captures / "face/train.txt").write_text("face/001-0.png\n")
    try:
        with pytest.raises(DataError, match="the train split holds no panorama"):
            load(captures / "face")
    finally:
        (captures / "face/train.txt").unlink()


@pytest.mark.parametrize("method", ["padgs", "cubemap_3dgs"])
def test_methods_that_draw_panoramas_only_say_so(method: str, captures: Path, tmp_path: Path) -> None:
    result = trained(captures / "face", tmp_path, f"method={method}", "train.iterations=2")
    assert result.status == "rejected"
    assert "face/001-0" in result.reason and "data.cameras=panoramas" in result.reason


def test_photographs_train_as_well_as_panoramas_with_equal_pixels(captures: Path, tmp_path: Path) -> None:
    quality = {}
    # An iteration on a mixed capture shows fewer pixels: a face of a cube has a fifth of a panorama's.
    for name, iterations in (("panorama", 75), ("face", 125), ("fisheye", 100)):
        settings = [f"train.iterations={iterations}", "run.pictures=false", "train.monitor=false"]
        result = trained(captures / name, tmp_path, *settings)
        quality[name] = result.scores["sphere"].metrics["ws_psnr"]
        assert result.cameras == (
            {} if name == "panorama" else dict.fromkeys(("panorama/002", "panorama/005"), "panorama")
        )
    assert min(quality["face"], quality["fisheye"]) > quality["panorama"] - 1


def test_photographs_are_scored_by_their_own_pixels(captures: Path) -> None:
    scene = load(captures / "face")
    photograph = next(view for view in scene.train if view.lens is not None)
    wrong = torch.rand(photograph.height, photograph.width, 3, generator=torch.Generator().manual_seed(0))
    zeros = torch.zeros(wrong.shape[:2])
    rendering = Rendering(wrong, zeros, zeros, torch.zeros(0, dtype=torch.bool))
    views = [photograph, *scene.test]

    def render(view: View) -> Rendering:
        if view is photograph:
            return rendering
        return Rendering(view.image() * 0.9, *[torch.zeros(view.height, view.width)] * 2, rendering.visible)

    scores = evaluate(render, views, replace(PROTOCOLS["sphere"], lpips="none", bottom_crop=0.5))
    marks = scores.views[photograph.name]
    error = ((wrong * 255).round() / 255 - photograph.image()).square().mean(-1).double()
    angles = pixel_solid_angles(photograph.camera)
    assert marks["psnr"] == pytest.approx(-10 * math.log10(error.mean()), abs=1e-4)
    assert marks["ws_psnr"] == pytest.approx(-10 * math.log10((error * angles).sum() / angles.sum()), abs=1e-4)
    assert marks["ws_psnr_pole"] is None and marks["seam"] is None and scores.metrics["seam"] is not None
