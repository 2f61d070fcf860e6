"""Perspective views resampled from panoramas."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from padgs.data.perspectives import looking_at, perspective_scene, perspective_views, square_lens
from padgs.data.store import ImageStore, StoredImage
from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import Panorama, Pinhole
from padgs.geometry.panorama import rays, sample
from padgs.render import Rendering, RenderOptions, render
from padgs.render.cubemap import FACES, face_camera, panorama_from_faces
from padgs.scene import Scene, View

WIDTH, HEIGHT = 256, 128


def pattern(directions: torch.Tensor) -> torch.Tensor:
    """Return a smooth function of the direction, uint8."""
    unit = torch.nn.functional.normalize(directions.double(), dim=-1)
    return (128 + 120 * torch.sin(3 * unit)).round().to(torch.uint8)


@pytest.fixture
def panorama(generator: torch.Generator) -> View:
    pixels = pattern(rays(WIDTH, HEIGHT, dtype=torch.float64))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrices(torch.randn(4, generator=generator, dtype=torch.float64))
    pose[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)
    return View("p", pose, WIDTH, HEIGHT, load_pixels=lambda: pixels)


def test_cube_faces_reproduce_the_panorama(panorama: View):
    assert (through_faces(panorama) - panorama.image()).abs().max() < 3 / 255


def test_cube_faces_preserve_detail(panorama: View, generator: torch.Generator):
    """Reproduce noise of three pixels: 37 dB. Bilinear sampling loses 2.5 dB, half the resolution 5.6 dB."""
    noise = torch.rand(1, 3, HEIGHT, WIDTH, generator=generator)
    image = (255 * torch.nn.functional.avg_pool2d(noise, 3, 1, 1)[0].permute(1, 2, 0)).to(torch.uint8)
    square = (through_faces(replace(panorama, load_pixels=lambda: image)) - image / 255).square().mean(-1)
    weight = rays(WIDTH, HEIGHT)[..., ::2].norm(dim=-1)  # cosine of the latitude
    assert -10 * torch.log10((weight * square).sum() / weight.sum()) > 36


def through_faces(panorama: View) -> torch.Tensor:
    """Resample a panorama to cube faces and back."""
    lens = face_camera(Panorama(WIDTH, HEIGHT))
    empty = torch.zeros(lens.height, lens.width)
    faces = [
        Rendering(view.image(), empty, empty, torch.zeros(0, dtype=torch.bool))
        for view in perspective_views(panorama, FACES, lens)
    ]
    return panorama_from_faces(faces, Panorama(WIDTH, HEIGHT), lens).image


def test_cut_views_are_drawn_as_often_as_their_panorama(panorama: View):
    faces = perspective_views(replace(panorama, share=0.25), FACES, face_camera(Panorama(64, 32)))
    assert [view.share for view in faces] == [0.25] * 6


def test_views_show_the_panorama_at_their_pose(panorama: View):
    for view in perspective_views(panorama, FACES, square_lens(panorama.camera, 1.0)):
        world = view.camera.rays(dtype=torch.float64) @ view.cam_from_world[:3, :3]
        in_panorama = world @ panorama.cam_from_world[:3, :3].T
        difference = pattern(in_panorama).int() - (view.image() * 255).round().int()
        assert difference.abs().max() <= 2
        torch.testing.assert_close(view.center, panorama.center)


def test_rendered_views_agree_with_resampled_panoramas(panorama: View, generator: torch.Generator):
    """Compare a resampled panorama with renders of the views, both of projection ray."""
    means = panorama.center.float() + 3 * torch.nn.functional.normalize(torch.randn(20, 3, generator=generator), dim=-1)
    quats, colors = torch.randn(20, 4, generator=generator), torch.rand(20, 3, generator=generator)
    scales = 0.3 + 0.3 * torch.rand(20, 3, generator=generator)
    gaussians = Gaussians(means, quats, scales, torch.full((20,), 0.8), colors)
    options, big = RenderOptions(projection="ray", low_pass=0.0), replace(panorama, width=512, height=256)
    whole = render(gaussians, big, options).image
    for rotation, view in zip(FACES, perspective_views(big, FACES, square_lens(big.camera, 1.0)), strict=True):
        expected = sample(whole, view.camera.rays(dtype=torch.float64) @ rotation)
        drawn = render(gaussians, view, options).image
        assert (drawn - expected).abs().mean() < 1e-3


def test_views_are_cached_in_the_store_of_the_panorama(tmp_path: Path, panorama: View):
    Image.fromarray(panorama.load_pixels().numpy()).save(tmp_path / "p.png")
    size = 3 * WIDTH * HEIGHT
    for limit, kept in ((10 * size, True), (size // 10, False)):
        store = ImageStore(limit, threads=0, folder=tmp_path)
        stored = replace(panorama, load_pixels=StoredImage(tmp_path / "p.png", WIDTH, HEIGHT, store))
        cut = perspective_views(stored, FACES, square_lens(panorama.camera, 1.0))
        pixels = [view.load_pixels() for view in cut]
        assert cut[0].load_pixels != replace(cut[0].load_pixels), "loaders are compared by identity"
        for view, before, free in zip(
            cut, pixels, perspective_views(panorama, FACES, square_lens(panorama.camera, 1.0)), strict=True
        ):
            view.prefetch()
            assert (view.load_pixels() is before) == kept, "cached within the limit of the store"
            assert torch.equal(before, free.load_pixels()), "with the same pixels"
        assert store.bytes <= store.limit_bytes


def test_masks_are_resampled_and_masked_colours_do_not_leak(panorama: View):
    """Paint masked pixels white, and look for white in the views."""
    directions = rays(WIDTH, HEIGHT, dtype=torch.float64)
    mask = (directions[..., 1] < 0.3).float()
    pixels = torch.where(mask[..., None] > 0, pattern(directions), 255).to(torch.uint8)
    masked = replace(panorama, load_pixels=lambda: pixels, load_mask=lambda: mask)
    for rotation, view in zip(FACES, perspective_views(masked, FACES, square_lens(masked.camera, 1.0)), strict=True):
        looks = view.camera.rays(dtype=torch.float64) @ rotation
        weight = view.mask()
        assert weight is not None
        height = looks[..., 1]
        assert (weight[height < 0.25] == 1).all() and (weight[height > 0.35] == 0).all()
        off = ((view.image() * 255).round().int() - pattern(looks).int()).abs().amax(-1)
        assert (off[weight > 0.02] <= 8).all()  # samples beside the edge lean on fewer neighbours


def test_fully_masked_views_are_dropped(panorama: View):
    mask = (rays(WIDTH, HEIGHT)[..., 1] < 0.5).float()
    masked = replace(panorama, load_mask=lambda: mask)
    scene = Scene("s", (panorama, masked), (panorama,), torch.zeros(1, 3), torch.zeros(1, 3).byte(), "")
    cut = perspective_scene(scene, FACES, lambda camera: square_lens(camera, 1.0))
    assert [view.name for view in cut.train] == [f"p-{i}" for i in (0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 5)]  # 4 looks down
    assert cut.test == scene.test, "whole panoramas are held out"
    assert cut.extent == pytest.approx(scene.extent) and cut.scale == pytest.approx(scene.scale)


def test_lenses_have_the_exact_field_of_view_and_the_panoramas_resolution():
    for tangent in (1.0, math.tan(math.radians(37.5))):
        lens = square_lens(Panorama(1000, 500), tangent)
        assert lens.width / 2 / lens.fx == pytest.approx(tangent)
        assert lens.focal == pytest.approx(Panorama(1000, 500).focal, rel=0.5 / lens.width)


def test_looking_at_has_no_roll(generator: torch.Generator):
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator, dtype=torch.float64), dim=-1)
    turns = looking_at(directions)
    torch.testing.assert_close(turns[:, 2], directions)
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).double().expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(20).double())
    assert (turns[:, 0, 1].abs() < 1e-12).all() and (turns[:, 1, 1] > 0).all()


def test_only_panoramas_are_resampled(panorama: View):
    pinhole = Pinhole(WIDTH, HEIGHT, 50, 50, 32, 16)
    with pytest.raises(ValueError, match="view 'p' has a Pinhole camera; only panoramas can be resampled"):
        perspective_views(replace(panorama, lens=pinhole), FACES, pinhole)
