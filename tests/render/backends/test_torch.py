"""The definition: results by hand, gradients in float64, independence of the block size."""

import math

import pytest
import torch
from support.render_cases import draw, gaussians_of, identity_pose, leaves, mixture

from padgs.gaussians import Gaussians
from padgs.render import RenderOptions, render
from padgs.render.backends import torch as torch_backend
from padgs.render.contract import kernel, largest_q
from padgs.scene import View

ENGINE = {"backend": "torch", "dtype": torch.float64}
OUTPUTS = ("image", "transmittance", "depth")


def row_of_gaussians(depths: list[float], opacities: list[float], colors: list[list[float]]) -> Gaussians:
    """Gaussians straight ahead, so broad that the four central pixels see (nearly) their full opacity."""
    count = len(depths)
    means = torch.tensor([[0.0, 0.0, depth] for depth in depths], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(count, 4)
    scales = 100 * means[:, 2:].expand(count, 3)
    return Gaussians(
        means, quats, scales, torch.tensor(opacities, dtype=torch.float64), torch.tensor(colors, dtype=torch.float64)
    )


def test_blending_by_hand():
    gaussians = row_of_gaussians([3.0, 1.0, 2.0], [0.5, 0.25, 0.8], [[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    rendering = draw(gaussians, 32, 16, background=background, **ENGINE)
    green, blue, red = 0.25, 0.75 * 0.8, 0.75 * 0.2 * 0.5
    left = 0.75 * 0.2 * 0.5
    expected = torch.tensor([red, green, blue], dtype=torch.float64) + left * background
    torch.testing.assert_close(rendering.image[8, 16], expected, atol=1e-5, rtol=0)
    assert rendering.transmittance[8, 16].item() == pytest.approx(left, abs=1e-5)
    depth = (green * 1 + blue * 2 + red * 3) / (green + blue + red)
    assert rendering.depth[8, 16].item() == pytest.approx(depth, abs=1e-5)


@pytest.mark.parametrize("steepness", [0.0, 0.3, 0.9])
def test_the_response_is_flatter_in_the_middle_with_a_steeper_edge(steepness: float):
    """On the horizon at angles of 0.5, 1 and 2 standard deviations; and where alpha falls to 1/255."""
    q = torch.tensor([0.0, 0.25, 1.0, 4.0], dtype=torch.float64)
    expected = [0.0, 0.25 - 0.1875 * steepness, 1.0, 4 + 12 * steepness]
    assert kernel(q, steepness).tolist() == pytest.approx(expected, abs=1e-14)
    opacities = torch.tensor([0.001, 1 / 255, 0.1, 0.99], dtype=torch.float64)
    reach = largest_q(opacities, steepness)
    assert reach[:2].tolist() == pytest.approx([0, 0], abs=1e-12)
    assert (opacities[2:] * torch.exp(-0.5 * kernel(reach[2:], steepness))).tolist() == pytest.approx([1 / 255] * 2)
    mean, size = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), 0.2
    quats, scales = mean.new_tensor([[1, 0, 0, 0]]), mean.new_tensor([[size, size, 1e-6]])
    gaussians = Gaussians(mean, quats, scales, mean.new_tensor([0.8]), mean.new_ones(1, 3))
    view, options = View("v", identity_pose(), 256, 128), RenderOptions("ray", low_pass=0.0, steepness=steepness)
    column = 128 + 8  # half a pixel further, as row 64 is half a pixel below the horizon
    longitude, latitude = 8.5 / 256 * 2 * math.pi, 0.5 / 128 * math.pi
    q = (math.tan(longitude) ** 2 + (math.tan(latitude) / math.cos(longitude)) ** 2) / size**2
    drawn = render(gaussians, view, options, backend="torch").image[64, column, 0].item()
    assert drawn == pytest.approx(0.8 * math.exp(-0.5 * (q * (1 - steepness) + steepness * q * q)), rel=1e-5)


def test_a_pixel_stops_before_it_is_opaque():
    colors = [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]
    rendering = draw(row_of_gaussians([1.0, 2.0, 3.0], [0.98, 0.98, 0.9], colors), 32, 16, **ENGINE)
    left = 0.02 * 0.02  # 4e-4; the third would leave 4e-5 < 1e-4
    assert rendering.transmittance[8, 16].item() == pytest.approx(left, rel=1e-2)
    assert rendering.image[8, 16, 2] == 0
    assert rendering.counters["contributing"] == 2 * 32 * 16


def test_alpha_is_limited_and_has_no_derivative_there():
    gaussians = leaves(row_of_gaussians([1.0], [1.0], [[1.0, 1.0, 1.0]]), torch.float64)
    rendering = render(gaussians, View("v", identity_pose(), 32, 16), backend="torch")
    assert rendering.transmittance[8, 16].item() == pytest.approx(0.01, abs=1e-12)
    (gradient,) = torch.autograd.grad(rendering.image[8, 16].sum(), gaussians.opacities)
    assert gradient.item() == 0


def test_pixel_centers():
    """A Gaussian on the corner of four pixels lights them equally; one on a pixel centre lights that most."""
    for columns, rows, expected in ((0.0, 0.0, 4), (0.5, 0.5, 1)):
        angles = torch.tensor([columns * 2 * math.pi / 32, rows * math.pi / 16], dtype=torch.float64)
        direction = [
            torch.cos(angles[1]) * torch.sin(angles[0]),
            torch.sin(angles[1]),
            torch.cos(angles[1]) * torch.cos(angles[0]),
        ]
        means = torch.stack(direction)[None]
        gaussians = Gaussians(
            means,
            torch.tensor([[1.0, 0, 0, 0]]).double(),
            torch.full((1, 3), 0.01).double(),
            torch.tensor([0.9]).double(),
            torch.ones(1, 3).double(),
        )
        image = draw(gaussians, 32, 16, **ENGINE).image[..., 0]
        brightest = (image > image.max() - 1e-9).nonzero()
        assert len(brightest) == expected
        assert brightest[-1].tolist() == [8, 16]


@pytest.mark.parametrize("pairs", [1, 300, 1 << 12])
def test_blocks_change_nothing(pairs: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch):
    gaussians = mixture(5, generator)
    view = View("v", identity_pose(), 20, 11)
    weights = [torch.randn(11, 20, generator=generator, dtype=torch.float64) for _ in OUTPUTS]

    def run() -> tuple:
        inputs = leaves(gaussians, torch.float64)
        pose = identity_pose().requires_grad_()
        rendering = render(inputs, view.at(pose), backend="torch")
        outputs = (rendering.image.sum(-1), rendering.transmittance, rendering.depth)
        loss = sum((output * weight).sum() for output, weight in zip(outputs, weights, strict=True))
        return rendering, torch.autograd.grad(loss, [*vars(inputs).values(), pose])

    whole, whole_gradients = run()
    monkeypatch.setattr(torch_backend, "PAIRS_PER_BLOCK", pairs)
    chunked, chunked_gradients = run()
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(chunked, name), getattr(whole, name), atol=1e-12, rtol=1e-12)
    for actual, expected in zip(chunked_gradients, whole_gradients, strict=True):
        torch.testing.assert_close(actual, expected, atol=1e-9 * expected.abs().max().item(), rtol=0)
    assert chunked.counters == whole.counters


def test_memory_is_bounded_by_the_block(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch):
    """Memory for the backward pass does not grow with the number of blocks."""
    gaussians = leaves(gaussians_of("ordinary", 40, generator), torch.float64)
    kept = {}
    for pairs in (1 << 30, 40 * 64):
        monkeypatch.setattr(torch_backend, "PAIRS_PER_BLOCK", pairs)
        sizes = []
        with torch.autograd.graph.saved_tensors_hooks(lambda t, s=sizes: s.append(t.numel()) or t, lambda t: t):
            render(gaussians, View("v", identity_pose(), 64, 32), backend="torch")
        kept[pairs] = sum(sizes)
    assert kept[40 * 64] < 0.1 * kept[1 << 30]


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize(
    "options",
    [
        RenderOptions("erp"),
        RenderOptions("erp", wrap=False),
        *(RenderOptions(projection, steepness=s) for projection in ("tangent", "ray") for s in (0.0, 0.4)),
        *(RenderOptions(projection, cubemap=True) for projection in ("pinhole", "tangent", "ray")),
    ],
    ids=str,
)
def test_gradcheck(output: str, options: RenderOptions):
    """Jacobians of all outputs against differences in float64."""
    gaussians = gaussians_of("seam", 3, torch.Generator().manual_seed(21))
    inputs = leaves(gaussians, torch.float64)
    pose = identity_pose()
    background = torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64, requires_grad=True)
    mean_offsets = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)

    def drawn(means, quats, scales, opacities, colors, top, background, mean_offsets):
        moved = torch.cat((top, pose[3:]))
        rendering = render(
            Gaussians(means, quats, scales, opacities, colors),
            View("v", moved, 12, 6),
            options,
            background=background,
            mean_offsets=mean_offsets,
            backend="torch",
        )
        return getattr(rendering, output)

    leaf_pose = pose[:3].clone().requires_grad_()
    assert torch.autograd.gradcheck(
        drawn, (*vars(inputs).values(), leaf_pose, background, mean_offsets), eps=1e-7, atol=1e-5, fast_mode=True
    )


def test_depth_follows_the_mean_and_transmittance_the_opacity():
    """Derivatives by hand: d depth / d r = 1 for a single Gaussian; d T / d o = -1 at its centre."""
    gaussians = leaves(row_of_gaussians([2.0], [0.5], [[1.0, 1.0, 1.0]]), torch.float64)
    rendering = render(gaussians, View("v", identity_pose(), 32, 16), backend="torch")
    (by_mean,) = torch.autograd.grad(rendering.depth[8, 16], gaussians.means, retain_graph=True)
    torch.testing.assert_close(by_mean, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), atol=1e-9, rtol=0)
    (by_opacity,) = torch.autograd.grad(rendering.transmittance[8, 16], gaussians.opacities)
    assert by_opacity.item() == pytest.approx(-1, abs=1e-4)


def test_mean_offsets_move_footprints():
    """The unit is half an image: the gradient in pixels is the gradient by mean_offsets over W / 2 and H / 2."""
    gaussians = gaussians_of("ordinary", 1, torch.Generator().manual_seed(4))
    view = View("v", identity_pose(), 64, 32)
    mean_offsets = torch.zeros(1, 2, dtype=torch.float64)
    reference = render(gaussians, view, mean_offsets=mean_offsets, backend="torch").image
    for axis, size in ((0, 64), (1, 32)):
        moved = mean_offsets.clone()
        moved[0, axis] = 3 / (size / 2)  # three pixels
        shifted = render(gaussians, view, mean_offsets=moved, backend="torch").image
        torch.testing.assert_close(shifted, torch.roll(reference, 3, dims=1 - axis), atol=1e-9, rtol=0)


def test_counters(generator: torch.Generator):
    gaussians = gaussians_of("ordinary", 10, generator)
    opacities = gaussians.opacities.clone()
    opacities[:4] = 1e-3  # below 1/255: never drawn
    rendering = draw(Gaussians(**{**vars(gaussians), "opacities": opacities}), 64, 32, **ENGINE)
    assert rendering.counters["gaussians"] == 10
    assert rendering.counters["visible"] == int(rendering.visible.sum()) == 6
    assert not rendering.visible[:4].any()
    assert 0 < rendering.counters["contributing"] <= rendering.counters["evaluated"] <= 6 * 64 * 32
