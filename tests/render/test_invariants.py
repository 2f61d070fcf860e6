"""What must hold for any renderer: T0 of the stability reference, N1-N7, N10, N11 (N8 and N9 have their own files).

N7, a rotation of the scene alone, is true of a panorama only about the vertical axis for the chart model: that is N4.
Here the whole world turns and moves together with the camera.
"""

from __future__ import annotations

import math

import pytest
import torch
from render_cases import (
    INPUTS,
    KINDS,
    draw,
    each_engine,
    gaussians_of,
    identity_pose,
    leaves,
    mixture,
    random_pose,
    stable_pixels,
)

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.panorama import direction, rays, row_latitudes
from padgs.render import RenderOptions, render
from padgs.scene import View


def one(mean, scale, *, quat=(1.0, 0.0, 0.0, 0.0), opacity=0.8, color=(0.3, 0.5, 0.7)) -> Gaussians:
    def row(values) -> torch.Tensor:
        return torch.tensor([values], dtype=torch.float64)

    return Gaussians(row(mean), row(quat), row(scale), row(opacity), row(color))


def yaw(angle: float) -> torch.Tensor:
    """A turn [3, 3] of directions to larger longitudes, about the camera's y axis."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], dtype=torch.float64)


EXTREME = {
    "on the camera": one((0, 0, 0), (0.1, 0.1, 0.1)),
    **{f"{r:g} from the camera": one((r, 0, r), (0.1, 0.1, 0.1)) for r in (1e-30, 1e-20, 1e-12, 1e-7, 1e-5, 1e-3)},
    **{
        f"{a:g} rad from the axis": one((0, s, a), (0.1, 0.2, 0.1))
        for a, s in ((0, 1), (1e-7, -1), (1e-5, 1), (1e-3, -1))
    },
    **{f"scale {s:g}": one((0, 0.3, 1), (s, s, s)) for s in (1e-30, 1e-8, 1e4, 1e12, 1e30)},
    "needle": one((0.2, 0.3, 1), (1e4, 1e-8, 1e-8), quat=(0.3, -0.5, 0.7, 0.1)),
    "very far": one((1e25, 0, 1e25), (1e24, 1e24, 1e24)),
    "opacity 0": one((0, 0.3, 1), (0.1, 0.2, 0.3), opacity=0.0),
    "opacity 1": one((0, 0.3, 1), (0.1, 0.2, 0.3), opacity=1.0),
    "tiny quaternion": one((0, 0.3, 1), (0.1, 0.2, 0.3), quat=(1e-18, 1e-18, 0, 0)),
}


@pytest.mark.parametrize("name", EXTREME)
@each_engine
def test_n1_n2_extreme_gaussians_stay_finite_beside_ordinary_ones(name: str, backend: str, dtype: torch.dtype):
    ordinary = gaussians_of("ordinary", 3, torch.Generator().manual_seed(1))
    both = Gaussians(**{key: torch.cat((getattr(EXTREME[name], key), getattr(ordinary, key))) for key in INPUTS})
    inputs, pose = leaves(both, dtype), identity_pose().to(dtype).requires_grad_()
    for options in (RenderOptions(), RenderOptions(wrap=False), RenderOptions(low_pass=0.0)):
        rendering = render(inputs, View("v", pose, 64, 32), options, backend=backend)
        outputs = (rendering.image, rendering.transmittance, rendering.depth)
        for output in outputs:
            assert torch.isfinite(output).all()
        gradients = torch.autograd.grad(sum(output.sum() for output in outputs), [*vars(inputs).values(), pose])
        for key, gradient in zip((*INPUTS, "pose"), gradients, strict=True):
            assert torch.isfinite(gradient).all(), key
        stepped = Gaussians(
            **{key: getattr(inputs, key).detach() - 1e-4 * g for key, g in zip(INPUTS, gradients, strict=False)}
        )
        assert torch.isfinite(render(stepped, View("v", pose, 64, 32), options, backend=backend).image).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities"])
@each_engine
def test_n2_a_non_finite_gaussian_is_rejected_or_not_drawn(name: str, bad: float, backend: str, dtype: torch.dtype):
    gaussians = gaussians_of("ordinary", 4, torch.Generator().manual_seed(2))
    broken = leaves(gaussians, dtype)
    getattr(broken, name).data[1] = bad
    with pytest.raises(ValueError, match=f"{name} holds .* non-finite"):
        draw(broken, 32, 16, backend=backend, dtype=dtype)
    rendering = render(broken, View("v", identity_pose(), 32, 16), backend=backend)
    if (name, bad) != ("opacities", math.inf):  # an opacity above the maximum is limited to it
        others = torch.tensor([0, 2, 3])
        expected = draw(
            Gaussians(**{key: getattr(gaussians, key)[others] for key in INPUTS}), 32, 16, backend=backend, dtype=dtype
        )
        torch.testing.assert_close(rendering.image, expected.image, rtol=0, atol=1e-6)
        rendering.image.sum().backward()
        assert torch.isfinite(broken.colors.grad).all() and torch.isfinite(broken.means.grad).all()
    assert torch.isfinite(rendering.image).all()


def footprint(sigma: float, latitude: float, *, backend: str, dtype: torch.dtype) -> tuple[float, float, torch.Tensor]:
    """L1 error and mass of one isotropic footprint against the exact ray response, both relative to the true mass.

    Area-weighted over the sphere; angles in degrees. Also the alpha [H, W] itself.
    """
    width = max(128, 2 * round(360 / sigma))  # a pixel is at most half a standard deviation: a sum is an integral
    mean = direction(torch.tensor(0.3, dtype=torch.float64), torch.deg2rad(torch.tensor(latitude, dtype=torch.float64)))
    scale = math.radians(sigma)
    gaussians = one(mean.tolist(), (scale, scale, scale), opacity=0.9, color=(1.0, 1.0, 1.0))
    options = RenderOptions(low_pass=0.0)
    drawn = draw(gaussians, width, width // 2, backend=backend, dtype=dtype, options=options).image[..., 0].double()
    cos = rays(width, width // 2, dtype=torch.float64) @ mean
    true = torch.where(cos > 0, 0.9 * torch.exp(-0.5 * (1 - cos * cos) / scale**2), torch.zeros(()).double())
    area = torch.cos(row_latitudes(width // 2, dtype=torch.float64))[:, None]
    mass = (area * true).sum()
    return ((area * (drawn - true).abs()).sum() / mass).item(), ((area * drawn).sum() / mass).item(), drawn


# Error of the chart model against the ray response, by angular size and latitude: baselines-and-projections.md 3.8.
CHART_ERROR = {
    2: {0: 0.002, 45: 0.014, 70: 0.038, 85: 0.156, 89: 0.289},
    5: {0: 0.012, 45: 0.036, 70: 0.094, 85: 0.275, 89: 0.183},
    10: {0: 0.048, 45: 0.076, 70: 0.173, 85: 0.245, 89: 0.09},
}


@pytest.mark.parametrize("sigma", CHART_ERROR)
@each_engine
def test_n3_a_chart_footprint_errs_by_its_own_law(sigma: int, backend: str, dtype: torch.dtype):
    for latitude, expected in CHART_ERROR[sigma].items():
        for side in (1, -1):
            error, _, _ = footprint(sigma, side * latitude, backend=backend, dtype=dtype)
            assert error == pytest.approx(expected, abs=0.006), latitude  # cutting at 1/255 is worth up to 0.005


@pytest.mark.parametrize("sigma", [1, 2, 4])
@each_engine
def test_n3_the_error_of_small_footprints_depends_on_sigma_over_colatitude(
    sigma: int, backend: str, dtype: torch.dtype
):
    for ratio, law, mass_law in ((0.5, 0.29, 1.23), (1, 0.285, 1.08), (3, 0.13, 1.0), (10, 0.04, 1.0)):
        error, mass, _ = footprint(sigma, 90 - ratio * sigma, backend=backend, dtype=dtype)
        assert error == pytest.approx(law, abs=0.012), ratio
        assert mass == pytest.approx(mass_law, abs=0.02), ratio


@each_engine
def test_n4_a_yaw_of_the_world_shifts_the_image(backend: str, dtype: torch.dtype):
    width, height = 128, 64
    gaussians = mixture(6, torch.Generator().manual_seed(4), ("ordinary", "polar", "seam", "near"))
    reference = draw(gaussians, width, height, backend=backend, dtype=dtype)
    for step in range(1, 64):
        pose = identity_pose()
        pose[:3, :3] = yaw(2 * math.pi * step / 64)
        turned = draw(gaussians, width, height, backend=backend, dtype=dtype, pose=pose)
        shifted = torch.roll(reference.image, step * width // 64, dims=1)
        error = (turned.image - shifted).abs().amax(-1)
        assert error.max() <= 1 / 255, step
        assert (error > 2e-5).double().mean() < 1e-3, step  # a pair within rounding of the cut may flip, no more


@each_engine
def test_n5_a_gaussian_over_the_pole_covers_all_longitudes(backend: str, dtype: torch.dtype):
    for sigma in (1, 5, 20, 60):
        for side in (1, -1):
            _, mass, drawn = footprint(sigma, side * (90 - 0.5 * sigma), backend=backend, dtype=dtype)
            edge = drawn[-1 if side > 0 else 0]
            assert (edge > 0).all(), f"{int((edge == 0).sum())} longitudes lost at sigma {sigma}"
            assert mass < 1.25  # the chart's own law; 1.23 is its limit for small footprints


@pytest.mark.parametrize("kind", KINDS)
@each_engine
def test_n6_the_unit_of_length_does_not_matter(kind: str, backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(6)
    gaussians, pose = gaussians_of(kind, 30, generator), random_pose(generator, shift=0.01)
    options = RenderOptions(near=0.003)
    stable = stable_pixels(gaussians, 70, 44, pose=pose, options=options)
    assert stable.double().mean() > 0.9
    reference = draw(gaussians, 70, 44, backend=backend, dtype=dtype, pose=pose, options=options)
    for unit in (1e-3, 0.1, 10, 1e3):
        larger = Gaussians(**{**vars(gaussians), "means": unit * gaussians.means, "scales": unit * gaussians.scales})
        moved = pose.clone()
        moved[:3, 3] *= unit
        scaled_options = RenderOptions(near=unit * options.near)
        scaled = draw(larger, 70, 44, backend=backend, dtype=dtype, pose=moved, options=scaled_options)
        assert (scaled.image - reference.image)[stable].abs().max() <= 2e-5
        torch.testing.assert_close(scaled.depth[stable], unit * reference.depth[stable], rtol=1e-4, atol=0)
        for counter in ("visible", "instances", "evaluated"):
            if counter in reference.counters:
                assert scaled.counters[counter] == pytest.approx(reference.counters[counter], rel=0.01), counter


@each_engine
def test_n7_moving_world_and_camera_together_changes_nothing(backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(7)
    gaussians = mixture(5, generator)
    stable = stable_pixels(gaussians, 64, 32)
    reference = draw(gaussians, 64, 32, backend=backend, dtype=dtype)
    for _ in range(30):
        pose = random_pose(generator, shift=0.0)  # a shift would cost the near Gaussians their digits
        rotation = pose[:3, :3]
        quats = gaussians.quats  # world_from_old = R^T: a rotation of each orientation, as a product of quaternions
        turn = quaternion_of(rotation.T)
        moved = Gaussians(**{**vars(gaussians), "means": gaussians.means @ rotation, "quats": product(turn, quats)})
        turned = draw(moved, 64, 32, backend=backend, dtype=dtype, pose=pose)
        assert (turned.image - reference.image)[stable].abs().max() <= 1e-4


def quaternion_of(rotation: torch.Tensor) -> torch.Tensor:
    """Unit quaternion (w, x, y, z) of a rotation [3, 3]: the eigenvector that it leaves alone, with its half angle."""
    k = torch.tensor(
        [[rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]]
    )
    w = 0.5 * torch.sqrt(1 + rotation.trace())
    quat = torch.cat((w[None], k[0].double() / (4 * w)))
    assert torch.allclose(rotation_matrices(quat), rotation, atol=1e-5)
    return quat


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Quaternion product a b, a [4], b [N, 4]."""
    scalar = a[0] * b[:, :1] - (a[1:] * b[:, 1:]).sum(-1, keepdim=True)
    vector = a[0] * b[:, 1:] + b[:, :1] * a[1:] + torch.linalg.cross(a[1:].expand(len(b), 3), b[:, 1:])
    return torch.cat((scalar, vector), dim=-1)


@each_engine
def test_n10_the_order_of_the_input_does_not_matter(backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(10)
    gaussians = mixture(8, generator)
    assert gaussians.means.float().norm(dim=-1).unique().numel() == len(gaussians), "the case has ties"
    reference = draw(gaussians, 70, 44, backend=backend, dtype=dtype)
    permutation = torch.randperm(len(gaussians), generator=generator)
    permuted = Gaussians(**{name: getattr(gaussians, name)[permutation] for name in INPUTS})
    rendering = draw(permuted, 70, 44, backend=backend, dtype=dtype)
    assert torch.equal(rendering.image, reference.image)
    assert torch.equal(rendering.visible, reference.visible[permutation])


@each_engine
def test_n10_equal_depths_are_drawn_in_the_order_of_the_input(backend: str, dtype: torch.dtype):
    red = one((0.1, 0, 2), (0.3, 0.3, 0.3), opacity=0.9, color=(1, 0, 0))
    blue = one((0.1, 0, 2), (0.3, 0.3, 0.3), opacity=0.9, color=(0, 0, 1))
    for first, second, channel in ((red, blue, 0), (blue, red, 2)):
        both = Gaussians(**{name: torch.cat((getattr(first, name), getattr(second, name))) for name in INPUTS})
        center = draw(both, 64, 32, backend=backend, dtype=dtype).image[16, 32]
        assert center[channel] > 0.8 and center[2 - channel] < 0.15


@each_engine
def test_n11_every_input_receives_a_gradient(backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(11)
    inputs = leaves(gaussians_of("ordinary", 20, generator), dtype)
    pose = random_pose(generator, shift=0.1).to(dtype).requires_grad_()
    background = torch.full((3,), 0.5, dtype=dtype, requires_grad=True)
    probe = torch.zeros(20, 2, dtype=dtype, requires_grad=True)
    everything = {**vars(inputs), "pose": pose, "background": background, "probe": probe}
    reached = {
        "image": set(everything),
        "transmittance": set(everything) - {"colors", "background"},
        "depth": set(everything) - {"colors", "background"},
    }
    for output, expected in reached.items():
        rendering = render(inputs, View("v", pose, 64, 32), background=background, probe=probe, backend=backend)
        value = getattr(rendering, output)
        weight = torch.randn(value.shape, generator=generator, dtype=torch.float64).to(dtype)
        gradients = torch.autograd.grad((value * weight).sum(), list(everything.values()), allow_unused=True)
        for name, gradient in zip(everything, gradients, strict=True):
            if name not in expected:
                assert gradient is None or not gradient.any(), f"{output} cannot depend on {name}"
                continue
            assert gradient is not None and torch.isfinite(gradient).all(), f"{output} by {name}"
            rows = gradient[:3] if name == "pose" else gradient
            assert (rows.reshape(len(rows), -1).norm(dim=-1) > 0).all(), f"{output} by {name} has empty rows"
