import json
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.tiny_run import tiny_run

import padgs
from padgs.apps.viewer.controls import FilmControls
from padgs.apps.viewer.renders import RunRenderer, ViewOptions, captioned, level, side_by_side, with_legend
from padgs.data.formats.path_file import read_path
from padgs.evaluation.images import to_uint8
from padgs.geometry.similarity import Similarity
from padgs.scene import View, move_origin


@pytest.fixture(scope="module")
def renderer(tmp_path_factory) -> RunRenderer:
    return RunRenderer(padgs.load_run(tiny_run(tmp_path_factory), device="cpu"))


@pytest.fixture(scope="module")
def anchors(tmp_path_factory) -> RunRenderer:
    return RunRenderer(padgs.load_run(tiny_run(tmp_path_factory, "method=padgs_small"), device="cpu"))


def test_panoramas_are_padded_renders_of_the_run(renderer):
    view = renderer.run.scene.train[1]
    image = renderer.render(ViewOptions("panorama"), view.cam_from_world, 32, 24)
    assert image.shape == (24, 32, 3) and image[:4].max() == image[20:].max() == 0
    assert np.array_equal(image[4:20], to_uint8(renderer.run.method.render(view).image))
    high = renderer.render(ViewOptions("panorama"), view.cam_from_world, 32, 8)
    assert high.shape == (8, 16, 3), "no wider than its height allows"


@pytest.mark.parametrize("camera", ["perspective", "panorama"])
@pytest.mark.parametrize("layer", ["colours", "depth", "error"])
def test_all_layers_cameras_and_resolutions(renderer, anchors, camera, layer):
    for shown in (renderer, anchors):
        pose = shown.run.scene.train[0].cam_from_world
        full = shown.render(ViewOptions(camera, layer), pose, 40, 20)
        assert full.shape == (20, 40, 3) and full.dtype == np.uint8 and full.std() > 0
        assert shown.render(ViewOptions(camera, layer), pose, 40, 20, resolution=0.25).shape == (5, 10, 3)


def test_the_error_is_that_of_the_nearest_view_without_masked_pixels(renderer):
    run = renderer.run
    view = run.scene.test[0]
    near = view.cam_from_world.clone()
    near[:3, 3] += 1e-3
    assert renderer.nearest(near).name == view.name
    here = renderer.render(ViewOptions("panorama", "error"), view.cam_from_world, 32, 16)
    assert np.abs(here.astype(int) - renderer.render(ViewOptions("panorama", "error"), near, 32, 16)).max() < 2
    masked = replace(view, load_mask=lambda: torch.zeros(16, 32))
    blind = replace(run, result=None)
    blind.__dict__["scene"] = replace(run.scene, test=(masked,))
    assert RunRenderer(blind).render(ViewOptions("panorama", "error"), view.cam_from_world, 32, 16)[..., 1].max() == 0


def test_cropped_gaussians_are_not_rendered(renderer, anchors):
    for shown in (renderer, anchors):
        view, far = shown.run.scene.train[0], ((1e6,) * 3, (2e6,) * 3)
        assert shown.can_crop
        assert shown.render(ViewOptions("panorama", crop=far), view.cam_from_world, 32, 16).max() == 0
        all_of_it = shown.render(ViewOptions("panorama", crop=((-1e6,) * 3, (1e6,) * 3)), view.cam_from_world, 32, 16)
        assert np.array_equal(all_of_it, shown.render(ViewOptions("panorama"), view.cam_from_world, 32, 16))
        assert shown.run.method.render(view).image.max() > 0, "the run itself is left as it is"


def test_a_box_is_in_the_given_world_also_after_poses_were_learned(renderer, monkeypatch):
    run = replace(renderer.run, method=renderer.run.method.with_renderer(renderer.run.method.render_config))
    means = run.method.model.splats.means.detach()
    low, high = means.double().quantile(0.3, dim=0), means.double().quantile(0.7, dim=0)
    inside = int(((means >= low) & (means <= high)).all(-1).sum())
    world = Similarity(0.5, translation=torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    monkeypatch.setattr(type(run.method), "world", world)
    box = tuple(tuple(world.inverse()(corner[None])[0].tolist()) for corner in (low - 1e-4, high + 1e-4))
    shown = RunRenderer(run)._method_for(run.scene.train[0].camera, box)
    assert len(shown.model.splats) == inside > 0


def test_side_by_side():
    found = side_by_side(np.zeros((4, 6, 3), np.uint8), np.full((4, 6, 3), 7, np.uint8))
    assert found.shape == (4, 14, 3) and found[0, 0, 0] == 0 and found[0, 7, 0] == 255 and found[0, 13, 0] == 7


def test_level_poses_keep_place_and_heading():
    up, pose = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [100, 20, 30], degrees=True).as_matrix())
    pose[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    found = level(pose, up)
    assert torch.allclose(View("", found, 1, 1).center, View("", pose, 1, 1).center)
    assert torch.allclose(-found[1, :3], up) and torch.allclose(found[:3, :3] @ found[:3, :3].mT, torch.eye(3).double())
    ahead = pose[2, :3] - (pose[2, :3] @ up) * up
    assert torch.allclose(found[2, :3], ahead / ahead.norm())
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # straight down
    assert torch.allclose(level(pose, up)[2, :3], torch.tensor([0.0, 1.0, 0.0]).double())


def test_labels_and_legends_cover_corners_only():
    image = np.zeros((100, 200, 3), np.uint8)
    assert captioned(image, "run")[:20, :60].max() > 200 and captioned(image, "run")[50:].max() == 0
    for layer in ("depth", "error"):
        found = with_legend(image, layer, 2.0, 4.0)
        assert found[-10:, :60].max() > 200 and found[:50].max() == 0 and not image.any()


def test_saved_films_are_paths_in_the_world_of_the_data(tmp_path):
    client, origin = MagicMock(), torch.tensor([100.0, 0.0, 0.0], dtype=torch.float64)
    poses = [torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)]
    poses[1][:3, 3] = torch.tensor([0.0, 0.0, 1.0])
    film = FilmControls(client, tmp_path, "a.ply --data D", origin, lambda: poses[0], True)
    film.save()
    assert "at least two" in film.words.content and not [*tmp_path.iterdir()]
    film.keyframes.extend(poses)
    film.save(), film.save()
    assert {file.name for file in tmp_path.iterdir()} == {"film.json", "film-2.json"}
    assert film.words.content == f"saved. `padgs render a.ply --data D --path {tmp_path / 'film-2.json'}`"
    found = move_origin(read_path(tmp_path / "film.json", 2, (0, 0, 1)), origin)
    assert torch.allclose(found, torch.stack(poses))


def test_a_film_that_cannot_be_saved_is_downloaded(tmp_path):
    (tmp_path / "file").touch()
    client, pose = MagicMock(), torch.eye(4, dtype=torch.float64)
    film = FilmControls(client, tmp_path / "file" / "run", "a.ply", torch.zeros(3), lambda: pose, True)
    film.keyframes.extend((pose, pose))
    film.save()
    (name, content), _ = client.send_file_download.call_args
    assert name == "film.json" and len(json.loads(content)["keyframes"]) == 2
    assert film.words.content.startswith("cannot write into")
    assert "downloaded: `padgs render a.ply --path film.json`" in film.words.content
