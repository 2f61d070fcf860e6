import math

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st
from torch.autograd.functional import jacobian

from padgs.geometry import panorama

W, H = 64, 32
coordinates = st.floats(-10, 10, allow_subnormal=False)
points = st.tuples(coordinates, coordinates, coordinates)


def double(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def unproject(pixels: torch.Tensor, width: int = W, height: int = H) -> torch.Tensor:
    """The direction through a pixel, the inverse of Eq. 7 and 6."""
    u, v = pixels.unbind(-1)
    return panorama.direction((u / width - 0.5) * (2 * math.pi), (v / height - 0.5) * math.pi)


@pytest.mark.parametrize(
    ("axis", "longitude", "latitude", "pixel"),
    [
        ((0, 0, 1), 0, 0, (W / 2, H / 2)),  # forward: the middle
        ((1, 0, 0), 90, 0, (3 * W / 4, H / 2)),  # right
        ((-1, 0, 0), -90, 0, (W / 4, H / 2)),  # left
        ((0, 0, -1), 180, 0, (W, H / 2)),  # backward: the seam
        ((0, 1, 0), 0, 90, (W / 2, H)),  # down: the last row
        ((0, -1, 0), 0, -90, (W / 2, 0)),  # up: the first row
        ((1, 0, 1), 45, 0, (5 * W / 8, H / 2)),
        ((0, 1, 1), 0, 45, (W / 2, 3 * H / 4)),
    ],
)
def test_known_directions(axis, longitude, latitude, pixel):
    for distance in (0.01, 1.0, 1000.0):
        point = double(*axis) * distance
        angles = torch.rad2deg(torch.stack(panorama.longitude_latitude(point)))
        assert angles.tolist() == pytest.approx([longitude, latitude], abs=1e-12)
        assert panorama.project(point, W, H).tolist() == pytest.approx(pixel, abs=1e-12)


@pytest.mark.parametrize("size", [(64, 32), (7, 5), (1, 1)])
def test_rays_go_through_pixel_centres(size):
    width, height = size
    directions = panorama.rays(width, height, dtype=torch.float64)
    assert directions.shape == (height, width, 3)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centres = torch.stack((columns + 0.5, rows + 0.5), dim=-1).double()
    torch.testing.assert_close(panorama.project(directions, width, height), centres, rtol=0, atol=1e-12)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(height, width).double())


def test_the_paper_uses_the_same_map_with_other_axes(generator):
    ours = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    x, y, z = -ours[:, 2], ours[:, 0], ours[:, 1]  # its axes
    phi, theta = torch.atan2(y, -x), torch.atan2(z, torch.sqrt(x * x + y * y))  # its Eq. 6
    u, v = (phi + math.pi) / (2 * math.pi) * W, (theta + math.pi / 2) / math.pi * H  # its Eq. 7
    torch.testing.assert_close(panorama.project(ours, W, H), torch.stack((u, v), dim=-1))


def test_it_is_the_equirectangular_camera_of_colmap(generator):
    pycolmap = pytest.importorskip("pycolmap")  # safe after torch, see padgs.data.formats.colmap
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=W, height=H, params=[W, H])
    ours = torch.randn(1000, 3, generator=generator, dtype=torch.float64)
    np.testing.assert_allclose(panorama.project(ours, W, H).numpy(), camera.img_from_cam(ours.numpy()), atol=1e-9)


@given(points)
@example((0.0, 1e-3, -1e-9))
def test_unproject_undoes_project(point):
    point = double(*point)
    assume(point.norm() > 1e-3)
    torch.testing.assert_close(unproject(panorama.project(point, W, H)), point / point.norm(), rtol=0, atol=1e-12)


@given(st.floats(1e-6, W - 1e-6), st.floats(1e-3, H - 1e-3))
def test_project_undoes_unproject(u, v):
    pixel = double(u, v)
    torch.testing.assert_close(panorama.project(unproject(pixel), W, H), pixel, rtol=0, atol=1e-9)


@given(st.floats(-math.pi, math.pi, exclude_min=True), st.floats(-math.pi / 2, math.pi / 2))
def test_angles_round_trip(longitude, latitude):
    u, v = panorama.pixel_from_angles(double(longitude), double(latitude), W, H)[0]
    angles = [(u / W - 0.5) * 2 * math.pi, (v / H - 0.5) * math.pi]
    assert [angle.item() for angle in angles] == pytest.approx([longitude, latitude], abs=1e-14)
    assert panorama.direction(double(longitude), double(latitude)).norm().item() == pytest.approx(1, abs=1e-15)


@given(points, st.integers(0, W - 1))
def test_a_yaw_is_a_shift(point, columns):
    point = double(*point)
    assume(torch.hypot(point[0], point[2]) > 1e-3)
    angle = double(2 * math.pi * columns / W).squeeze()
    sine, cosine = torch.sin(angle), torch.cos(angle)
    x, y, z = point
    turned = torch.stack((cosine * x + sine * z, y, cosine * z - sine * x))
    shift = panorama.project(turned, W, H) - panorama.project(point, W, H)
    error = torch.remainder(shift[0] - columns + W / 2, W) - W / 2  # modulo the seam
    assert abs(error.item()) < 1e-9 and abs(shift[1].item()) < 1e-9


def test_latitude_is_accurate_near_the_poles():
    colatitude = torch.logspace(-6, -2, 50, dtype=torch.float64)
    exact = torch.stack((torch.sin(colatitude), torch.cos(colatitude), torch.zeros(50).double()), dim=-1)
    error = math.pi / 2 - panorama.longitude_latitude(exact.float())[1].double() - colatitude
    assert error.abs().max() < 2e-7  # one rounding of pi / 2; asin(y / r) is wrong by 3e-4 there
    assert (torch.asin(exact.float()[:, 1]).double() - math.pi / 2 + colatitude).abs().max() > 1e-4


def expected_jacobian(point: torch.Tensor) -> torch.Tensor:
    result = jacobian(lambda p: panorama.project(p, W, H), point)
    assert isinstance(result, torch.Tensor)
    return result


@given(points)
@example((0.0, 0.0, -2.0))
@example((3.0, 0.0, 0.0))  # known: W / 2 pi / r along -z, H / pi / r along y
def test_jacobian_agrees_with_autograd(point):
    point = double(*point)
    assume(torch.hypot(point[0], point[2]) > 1e-3)
    torch.testing.assert_close(
        panorama.projection_jacobian(point, W, H), expected_jacobian(point), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("colatitude", [1e-2, 1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize("pole", [-1, 1])
@pytest.mark.parametrize("longitude", [0.0, 2.0, -math.pi / 2])
def test_jacobian_agrees_with_autograd_near_the_poles(colatitude, pole, longitude):
    latitude = pole * (math.pi / 2 - colatitude)
    horizontal = 3 * math.sin(colatitude)  # and not cos(latitude), which has lost its digits
    point = double(horizontal * math.sin(longitude), 3 * math.sin(latitude), horizontal * math.cos(longitude))
    ours, theirs = panorama.projection_jacobian(point, W, H), expected_jacobian(point)
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    assert ours[0].norm().item() == pytest.approx(W / (2 * math.pi) / horizontal, rel=1e-9)  # one turn = W pixels
    assert ours[1].norm().item() == pytest.approx(H / math.pi / 3, rel=1e-9)  # half a turn = H pixels


@pytest.mark.parametrize("pole", [-1, 1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_jacobian_on_the_axis_is_the_limit_from_ahead(pole, dtype):
    on_axis = torch.tensor((0.0, 2.0 * pole, 0.0), dtype=dtype)
    beside = on_axis + torch.tensor((0.0, 0.0, 1e-12), dtype=dtype)
    options = {"min_cos_latitude": 1e-4}
    ours = panorama.projection_jacobian(on_axis, W, H, **options)
    assert torch.isfinite(ours).all()
    torch.testing.assert_close(ours, panorama.projection_jacobian(beside, W, H, **options))
    assert ours[0, 0].item() == pytest.approx(W / (2 * math.pi) / (2 * 1e-4), rel=1e-5)


def test_jacobian_limit_changes_only_smaller_values():
    point = double(0.3, 1.0, 0.2)
    cosine = (torch.hypot(point[0], point[2]) / point.norm()).item()
    free = panorama.projection_jacobian(point, W, H)
    assert torch.equal(panorama.projection_jacobian(point, W, H, min_cos_latitude=0.9 * cosine), free)
    limited = panorama.projection_jacobian(point, W, H, min_cos_latitude=2 * cosine)
    torch.testing.assert_close(limited, free * double(0.5, 1)[:, None])


def test_jacobian_is_differentiable_also_on_the_axis():
    point = double(0.0, 1.0, 0.0).requires_grad_()
    panorama.projection_jacobian(point, W, H, min_cos_latitude=1e-4).sum().backward()
    assert torch.isfinite(point.grad).all()
    others = torch.tensor([[0.3, -0.8, 0.5], [-1.0, 0.1, -2.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: panorama.projection_jacobian(p, W, H), others)


def test_samples_at_pixel_coordinates_are_exact_wrap_and_have_gradients(generator):
    image = torch.rand(4, 8, 2, generator=generator, dtype=torch.float64)
    columns, rows = torch.meshgrid(torch.arange(8) + 0.5, torch.arange(4) + 0.5, indexing="xy")
    centres = torch.stack((columns, rows), dim=-1).double()
    assert torch.equal(panorama.sample_pixels(image, centres), image)
    assert torch.equal(panorama.sample_pixels(image, centres + torch.tensor([16.0, 0.0])), image)
    assert panorama.sample_pixels((image * 255).to(torch.uint8), centres).dtype == torch.float32
    places = (centres + 0.3).requires_grad_()
    assert torch.autograd.gradcheck(panorama.sample_pixels, (image.requires_grad_(), places))


def test_sharp_samples_keep_the_pixels_and_err_less_between_them(generator):
    """Errors for a smooth function of the direction, poles and seam included: third order, second order if bilinear."""

    def smooth(directions):
        return torch.sin(4 * directions) + directions.roll(1, -1)

    image = smooth(panorama.rays(64, 32, dtype=torch.float64))
    assert torch.allclose(panorama.sample_bicubic(image, panorama.rays(64, 32, dtype=torch.float64)), image, atol=1e-9)
    anywhere = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator, dtype=torch.float64), dim=-1)
    pole = torch.tensor([[0.02, 1.0, 0.03], [-0.04, -1.0, 0.01], [0.001, 0.2, -1.0], [-0.001, 0.2, -1.0]]).double()
    for directions in (anywhere, torch.nn.functional.normalize(pole, dim=-1)):
        error, blurred = (
            (of(image, directions) - smooth(directions)).abs().max()
            for of in (panorama.sample_bicubic, panorama.sample)
        )
        assert error < 0.5 * blurred
    assert panorama.sample_bicubic((image * 50 + 100).byte(), anywhere.view(10, 50, 3)).shape == (10, 50, 3)


def test_a_row_beyond_a_pole_is_the_same_row_half_a_turn_further(generator):
    """Halfway from the centres of the first row to the pole, the value across the pole has weight 1/4."""
    image = torch.rand(16, 32, 1, generator=generator)
    at = unproject(torch.tensor([[5.5, 0.25], [7.5, 15.75]], dtype=torch.float64), 32, 16)
    expected = torch.stack((0.75 * image[0, 5] + 0.25 * image[0, 21], 0.75 * image[15, 7] + 0.25 * image[15, 23]))
    assert torch.allclose(panorama.sample(image, at), expected, atol=1e-6)


def test_continuation_past_a_pole_is_the_opposite_meridian():
    columns = torch.arange(8).expand(4, 8) + 10 * torch.arange(4)[:, None]  # pixel = 10 row + column
    padded = panorama.pad_panorama(columns, 2)
    assert padded.shape == (8, 12)
    assert padded[1, 2:-2].tolist() == [4, 5, 6, 7, 0, 1, 2, 3]  # row -1 = row 0, turned by half
    assert padded[0, 2:-2].tolist() == [14, 15, 16, 17, 10, 11, 12, 13]  # row -2 = row 1
    assert padded[-1, 2:-2].tolist() == [24, 25, 26, 27, 20, 21, 22, 23]
    assert padded[2].tolist() == [6, 7, 0, 1, 2, 3, 4, 5, 6, 7, 0, 1]


def test_continuation_goes_around_the_whole_sphere():
    columns = torch.arange(4).expand(2, 4) + 10 * torch.arange(2)[:, None]
    rows = panorama.pad_panorama(columns, 5)[:, 5:-5]  # five rows are more than the way to the other pole
    down, up = [columns[0].tolist(), columns[1].tolist()], [[12, 13, 10, 11], [2, 3, 0, 1]]
    assert rows.tolist() == [up[1], *down, *up, *down, *up, *down, up[0]]


def test_a_panorama_of_an_odd_width_cannot_be_continued():
    with pytest.raises(ValueError, match="9x4.*must be even"):
        panorama.pad_panorama(torch.zeros(4, 9, 3), 2)
