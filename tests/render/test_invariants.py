"""Invariances of every renderer: position, direction, unit of length, order of the input."""

import math

import pytest
import torch
from support import render_cases as cases

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.render import RenderOptions


def yaw(angle: float) -> torch.Tensor:
    """Return the rotation [3, 3] about the y axis of the camera to larger longitudes."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], dtype=torch.float64)


@cases.each_panorama
@cases.each_engine
def test_a_yaw_of_the_world_shifts_the_image(projection: str, backend: str, dtype: torch.dtype):
    width, height = 64, 33
    gaussians = cases.mixture(6, torch.Generator().manual_seed(4), ("ordinary", "polar", "seam", "near"))
    engine = {"backend": backend, "dtype": dtype, "options": RenderOptions(projection)}
    reference = cases.draw(gaussians, width, height, **engine)
    for step in range(1, 64, 7):
        pose = cases.identity_pose()
        pose[:3, :3] = yaw(2 * math.pi * step / 64)
        turned = cases.draw(gaussians, width, height, pose=pose, **engine)
        shifted = torch.roll(reference.image, step, dims=1)
        error = (turned.image - shifted).abs().amax(-1)
        assert error.max() <= 1 / 255, step
        assert (error > 2e-5).double().mean() < 1e-3, step  # a pair within rounding of the cut may flip, no more


@pytest.mark.parametrize("kind", cases.KINDS)
@cases.each_setup
@cases.each_engine
def test_the_unit_of_length_does_not_matter(kind: str, projection: str, lens: str, backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(6)
    gaussians, pose = cases.gaussians_of(kind, 20, generator), cases.random_pose(generator, shift=0.01)
    options, engine = RenderOptions(projection, near=0.003), {"backend": backend, "dtype": dtype, "lens": lens}
    stable = cases.stable_pixels(gaussians, 50, 30, lens=lens, pose=pose, options=options)
    assert stable.double().mean() > 0.9
    reference = cases.draw(gaussians, 50, 30, pose=pose, options=options, **engine)
    for unit in (1e-3, 0.1, 10, 1e3):
        larger = Gaussians(**{**vars(gaussians), "means": unit * gaussians.means, "scales": unit * gaussians.scales})
        moved = pose.clone()
        moved[:3, 3] *= unit
        scaled_options = RenderOptions(projection, near=unit * options.near)
        scaled = cases.draw(larger, 50, 30, pose=moved, options=scaled_options, **engine)
        limit = 1e-4 if kind == "needle" else 2e-5
        assert (scaled.image - reference.image)[stable].abs().max() <= limit
        torch.testing.assert_close(scaled.depth[stable], unit * reference.depth[stable], rtol=1e-4, atol=0)
        for counter in ("visible", "instances", "evaluated"):
            if counter in reference.counters:
                assert scaled.counters[counter] == pytest.approx(reference.counters[counter], rel=0.01), counter


@cases.each_setup
@cases.each_engine
def test_rigid_motion_changes_nothing(projection, lens, backend, dtype):
    generator = torch.Generator().manual_seed(7)
    gaussians, options = cases.mixture(4, generator), RenderOptions(projection)
    stable = cases.stable_pixels(gaussians, 48, 24, lens=lens, options=options)
    engine = {"backend": backend, "dtype": dtype, "lens": lens, "options": options}
    reference = cases.draw(gaussians, 48, 24, **engine)
    for _ in range(30 if backend == "cpu" else 5):
        pose = cases.random_pose(generator, shift=0.0)  # a shift would cost the near Gaussians their digits
        rotation = pose[:3, :3]
        quats = gaussians.quats  # world_from_old = R^T: a rotation of each orientation, as a product of quaternions
        turn = quaternion_of(rotation.T)
        moved = Gaussians(**{**vars(gaussians), "means": gaussians.means @ rotation, "quats": product(turn, quats)})
        turned = cases.draw(moved, 48, 24, pose=pose, **engine)
        assert (turned.image - reference.image)[stable].abs().max() <= 1e-4


def quaternion_of(rotation: torch.Tensor) -> torch.Tensor:
    """Return the unit quaternion (w, x, y, z) of a rotation [3, 3]."""
    k = torch.tensor(
        [[rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]]
    )
    w = 0.5 * torch.sqrt(1 + rotation.trace())
    quat = torch.cat((w[None], k[0].double() / (4 * w)))
    assert torch.allclose(rotation_matrices(quat), rotation, atol=1e-5)
    return quat


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the quaternion products a b of a [4] and b [N, 4]."""
    scalar = a[0] * b[:, :1] - (a[1:] * b[:, 1:]).sum(-1, keepdim=True)
    vector = a[0] * b[:, 1:] + b[:, :1] * a[1:] + torch.linalg.cross(a[1:].expand(len(b), 3), b[:, 1:])
    return torch.cat((scalar, vector), dim=-1)


@cases.each_setup
@cases.each_engine
def test_input_order_does_not_matter(projection, lens, backend, dtype):
    generator = torch.Generator().manual_seed(10)
    gaussians = cases.mixture(8, generator)
    assert gaussians.means.float().norm(dim=-1).unique().numel() == len(gaussians), "the case has ties"
    engine = {"backend": backend, "dtype": dtype, "lens": lens, "options": RenderOptions(projection)}
    reference = cases.draw(gaussians, 35, 22, **engine)
    permutation = torch.randperm(len(gaussians), generator=generator)
    rendering = cases.draw(cases.chosen(gaussians, permutation), 35, 22, **engine)
    assert torch.equal(rendering.image, reference.image)
    assert torch.equal(rendering.visible, reference.visible[permutation])


@pytest.mark.parametrize("blending", ["sorted", "hybrid"])
@cases.each_setup
@cases.each_engine
def test_ties_keep_the_input_order(projection, lens, blending, backend, dtype):
    def ball(color: tuple[float, float, float]) -> Gaussians:
        row = ((0.1, 0, 2), (1.0, 0, 0, 0), (0.5, 0.5, 0.5), 0.95, color)
        return Gaussians(*(torch.tensor([value], dtype=torch.float64) for value in row))

    red, blue = ball((1, 0, 0)), ball((0, 0, 1))
    for first, second, channel in ((red, blue, 0), (blue, red, 2)):
        options = RenderOptions(projection, **cases.blended(blending, 2))
        image = cases.draw(
            cases.joined(first, second), 64, 32, lens=lens, backend=backend, dtype=dtype, options=options
        ).image
        row, column = divmod(int(image.sum(-1).argmax()), 64)
        assert image[row, column, channel] > 0.8 and image[row, column, 2 - channel] < 0.15
