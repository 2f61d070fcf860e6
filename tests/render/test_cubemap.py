"""Cubemaps: geometry, interpolation, seams, gradients."""

import math
from dataclasses import replace

import pytest
import torch
from support.render_cases import (
    differentiated,
    draw,
    each_engine,
    gaussians_of,
    identity_pose,
    mixture,
    needs_native,
    random_pose,
    row_error,
)

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama, Pinhole
from padgs.geometry.panorama import rays
from padgs.render import Rendering, RenderOptions, cubemap, render
from padgs.render.cubemap import FACES, FINENESS, _corners, face_camera, panorama_from_faces
from padgs.scene import View

PROJECTIONS = ("pinhole", "tangent", "ray")
SIZES = ((64, 32), (70, 44), (33, 17), (8, 4), (2, 1))
PLACES = {  # where a Gaussian can lie on a cube
    "middle of a face": (0, 0, 1),
    "edge": (1, 0.1, 1),
    "lower edge": (-0.2, 1, 1),
    "corner": (-1, -1, -1),
    "pole": (0.05, -1, 0.02),
    "seam of the panorama": (0.01, 0.3, -1),
}


def broad(place: str, sigma: float = 8.0) -> Gaussians:
    """Return an isotropic Gaussian, sigma in degrees, two units away."""
    mean = 2 * torch.nn.functional.normalize(torch.tensor([PLACES[place]], dtype=torch.float64), dim=-1)
    scales = torch.full((1, 3), 2 * math.radians(sigma), dtype=torch.float64)
    quats, opacities = torch.tensor([[1.0, 0, 0, 0]]).double(), torch.tensor([0.9]).double()
    return Gaussians(mean, quats, scales, opacities, torch.tensor([[1.0, 0.5, 0.25]]).double())


def seen_by_faces(panorama: Panorama, lens: Pinhole) -> list[Rendering]:
    """Return renderings of a world whose colours are the directions."""
    local = lens.rays(dtype=torch.float64)
    empty = local.new_zeros(local.shape[:2])
    return [Rendering(local @ turn, empty, empty + 3.0, torch.ones(1, dtype=torch.bool)) for turn in FACES]


def test_faces_are_rotations_along_all_axes():
    torch.testing.assert_close(FACES @ FACES.mT, torch.eye(3, dtype=torch.float64).expand(6, 3, 3))
    assert torch.equal(torch.linalg.det(FACES), torch.ones(6, dtype=torch.float64))
    assert torch.equal(FACES[:, 2].unique(dim=0), torch.cat((torch.eye(3), -torch.eye(3))).double().unique(dim=0))
    assert face_camera(Panorama(1024, 512)).focal == pytest.approx(2 * 1024 / (2 * math.pi))
    assert face_camera(Panorama(100, 100)).focal == pytest.approx(2 * 100 / math.pi)


@pytest.mark.parametrize("fineness", [0.1, 1, 2])
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_every_pixel_is_interpolated_inside_one_face(monkeypatch, width: int, height: int, fineness: float):
    monkeypatch.setattr(cubemap, "FINENESS", fineness)
    panorama = Panorama(width, height)
    lens = face_camera(panorama)
    assert lens.width / 2 / lens.fx >= 1 + 1 / lens.fx  # 90 degrees and a pixel at each border
    pixels, weights = _corners(panorama, lens, torch.device("cpu"))
    assert (weights >= 0).all() and torch.allclose(weights.sum(-1), weights.new_ones(len(weights)))
    face, within = pixels // lens.width**2, pixels % lens.width**2
    assert (face == face[:, :1]).all() and face.min() >= 0 and face.max() <= 5
    row, column = within // lens.width, within % lens.width
    assert (column[:, 1] - column[:, 0] == 1).all() and (row[:, 2] - row[:, 0] == 1).all()


@pytest.mark.parametrize(
    ("projection", "kind"), [("pinhole", "pixels"), ("pinhole", "solid"), ("tangent", "angular"), ("ray", "solid")]
)
@each_engine
def test_low_pass_does_not_depend_on_the_pixels_of_faces(monkeypatch, projection, kind, backend, dtype):
    """The low-pass has the size of pixels of the panorama; finer faces do not change it."""
    options = RenderOptions(projection=projection, cubemap=True, low_pass_kind=kind, low_pass=4.0)
    gaussian = replace(broad("middle of a face", 3.0), means=torch.tensor([[0.02, 0.01, 2.0]]).double())
    images = []
    for fineness in (2, 8):
        monkeypatch.setattr(cubemap, "FINENESS", fineness)
        images.append(draw(gaussian, 128, 64, backend=backend, dtype=dtype, options=options).image)
    coarse, fine = images
    assert fine.max() > 0.02
    assert (coarse - fine).abs().max() < 0.06 * fine.max() + 1 / 255


@pytest.mark.parametrize(("width", "height"), [(64, 32), (70, 44), (256, 128)])
def test_directions_are_interpolated_to_second_order(width: int, height: int):
    panorama = Panorama(width, height)
    lens = face_camera(panorama)
    result = panorama_from_faces(seen_by_faces(panorama, lens), panorama, lens)
    error = (result.image - rays(width, height, dtype=torch.float64)).norm(dim=-1)
    # Along a row of a face the unit ray bends by at most 1 / f^2 a pixel: h^2 / 8 times that, for rows and columns.
    assert error.max() <= 2 / 8 / lens.fx**2
    torch.testing.assert_close(result.depth, torch.full_like(result.depth, 3))
    torch.testing.assert_close(result.transmittance, torch.zeros_like(result.depth))


@pytest.mark.parametrize("projection", PROJECTIONS)
@each_engine
def test_constant_colors_stay_constant(projection: str, backend: str, dtype: torch.dtype, generator):
    gaussians = gaussians_of("ordinary", 30, generator)
    color = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
    gaussians = replace(gaussians, colors=color.expand(30, 3))
    options = RenderOptions(projection=projection, cubemap=True)
    rendering = draw(gaussians, 70, 44, backend=backend, dtype=dtype, options=options, background=color)
    torch.testing.assert_close(rendering.image, color.to(dtype).expand(44, 70, 3), rtol=0, atol=2e-6)
    assert rendering.transmittance.min() < 0.9


@pytest.mark.parametrize("place", PLACES)
@each_engine
def test_ray_projection_has_no_seams(place: str, backend: str, dtype: torch.dtype):
    """At edges and corners of the cube the error is that of interpolation, as at the centre of a face."""
    options, sigma = RenderOptions(projection="ray", low_pass=0.0), 8.0
    for width in (128, 256):
        whole = draw(broad(place, sigma), width, width // 2, backend=backend, dtype=dtype, options=options)
        options_of_faces = replace(options, cubemap=True)
        faces = draw(broad(place, sigma), width, width // 2, backend=backend, dtype=dtype, options=options_of_faces)
        error = (faces.image - whole.image).abs().amax(-1)
        # Bilinear: (|f_uu| + |f_vv|) / 8 <= 2 o / 8 (h / sigma)^2, a pixel being h = 1 / f at the centre of a face.
        bound = 0.9 / 4 * (2 * math.pi / (FINENESS * width) / math.radians(sigma)) ** 2
        smooth = whole.transmittance < 1 - 4 / 255  # away from where alpha is cut off at 1/255
        assert error[smooth].max() <= bound
        assert error.max() <= bound + 1 / 255
        assert smooth.sum() > 100


@each_engine
def test_depth_does_not_mix_with_empty_pixels(backend: str, dtype: torch.dtype):
    for place in PLACES:
        options = RenderOptions(projection="ray", cubemap=True)
        rendering = draw(broad(place), 64, 32, backend=backend, dtype=dtype, options=options)
        covered = rendering.depth > 0
        assert torch.equal(covered, rendering.transmittance < 1)
        torch.testing.assert_close(
            rendering.depth[covered], torch.full_like(rendering.depth[covered], 2.0), rtol=1e-5, atol=0
        )
        assert 20 < covered.sum() < 64 * 32 / 2


@pytest.mark.parametrize("projection", PROJECTIONS)
@needs_native
def test_native_faces_match_the_definition(projection: str, generator):
    gaussians = gaussians_of("ordinary", 25, generator)
    pose = random_pose(generator, shift=0.1)
    weights = torch.rand(36, 72, 5, generator=generator, dtype=torch.float64)
    weights[..., 4] *= 0.1
    arguments = (gaussians, Panorama(72, 36), RenderOptions(projection=projection, cubemap=True, near=0.05), weights)
    expected, expected_gradients = differentiated(*arguments, pose=pose, backend="torch", dtype=torch.float64)
    actual, gradients = differentiated(*arguments, pose=pose, backend="cpu", dtype=torch.float32)
    assert ((actual.image - expected.image).abs().amax(-1) > 2e-5).double().mean() < 5e-3  # pairs at the cut may flip
    assert torch.equal(actual.visible, expected.visible)
    assert actual.counters["contributing"] == pytest.approx(expected.counters["contributing"], rel=1e-3)
    for name, gradient in gradients.items():
        assert row_error(gradient, expected_gradients[name]) < 5e-3, name


@pytest.mark.parametrize("projection", ["tangent", "ray"])
@needs_native
def test_native_faces_are_complete_and_efficient(monkeypatch, projection: str, generator):
    """Gaussians beside a face are the hard case; almost every Gaussian is beside some face."""
    gaussians = mixture(12, generator)
    lens = Pinhole(70, 44, 28.0, 33.0, 11.5, 30.25)  # wide, and its axis far from its middle
    options = RenderOptions(projection=projection, near=0.001)
    for _ in range(6):
        view = View("v", random_pose(generator), lens.width, lens.height, lens=lens)
        expected = render(gaussians, view, options, backend="torch")
        actual = render(gaussians.to(torch.float32), view, options, backend="cpu")
        error = (actual.image - expected.image).abs().amax(-1)
        assert error.max() <= 1 / 255 and (error > 2e-5).double().mean() < 5e-3  # pairs at the cut may flip
        drawn = actual.counters["contributing"] / expected.counters["contributing"]
        assert drawn == pytest.approx(1, rel=2e-3)

    small = gaussians_of("ordinary", 300, generator)
    small = replace(small, scales=0.15 * small.scales).to(torch.float32)
    monkeypatch.setattr(cubemap, "FINENESS", 1)
    whole, faces = (
        render(small, View("v", identity_pose(), 512, 256), how).counters["instances"]
        for how in (options, replace(options, cubemap=True))
    )
    assert faces < 1.6 * whole  # 1.3, as faces are finer towards their edges; whole faces in vain made it 15


@each_engine
def test_mean_offsets_match_the_panorama(backend: str, dtype: torch.dtype):
    """The positional gradient does not depend on how a panorama is rendered."""
    weight = torch.rand(64, 128, 3, generator=torch.Generator().manual_seed(5)).to(dtype)
    weight = torch.nn.functional.avg_pool2d(weight.movedim(-1, 0), 9, 1, 4).movedim(0, -1)  # smooth, for interpolation
    for place in ("middle of a face", "edge", "corner"):
        signals = []
        for as_cube in (False, True):
            mean_offsets = torch.zeros(1, 2, dtype=dtype, requires_grad=True)
            options = RenderOptions(projection="ray", cubemap=as_cube)
            rendering = draw(
                broad(place), 128, 64, backend=backend, dtype=dtype, options=options, mean_offsets=mean_offsets
            )
            (signal,) = torch.autograd.grad((rendering.image * weight).sum(), mean_offsets)
            signals.append(signal)
        assert (signals[0] - signals[1]).norm() < 0.03 * signals[0].norm(), place


def test_visibility():
    gaussians = replace(broad("edge"), opacities=torch.tensor([1e-3]).double())
    rendering = render(gaussians, View("v", identity_pose(), 32, 16), RenderOptions(projection="ray", cubemap=True))
    assert rendering.visible.tolist() == [False] and rendering.counters["visible"] == 0
    shown = render(broad("edge"), View("v", identity_pose(), 32, 16), RenderOptions(projection="ray", cubemap=True))
    assert shown.visible.tolist() == [True] and shown.counters["gaussians"] == 1
