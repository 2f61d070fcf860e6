import json
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from padgs.geometry.distortion import solid_angle_weight
from padgs.training.loss import photometric_loss, pixel_weight, ssim_map, window_mean

CASES = ("metrics_a", "metrics_b")


def load(shared, name: str, dtype=torch.float32) -> tuple[dict[str, Tensor], dict]:
    data = np.load(shared / "golden" / f"{name}.npz")
    tensors = {key: torch.from_numpy(data[key]) for key in data.files if key != "meta"}
    return {k: v.to(dtype) if v.is_floating_point() else v for k, v in tensors.items()}, json.loads(str(data["meta"]))


def test_two_grey_images_have_the_similarity_of_their_means_far_from_the_border():
    a, b = 0.25, 0.5
    similarity = ssim_map(torch.full((30, 30, 1), a), torch.full((30, 30, 1), b))[15, 15, 0]
    assert similarity.item() == pytest.approx((2 * a * b + 1e-4) / (a * a + b * b + 1e-4), rel=1e-4)


def test_window_is_the_gaussian_of_sigma_one_and_a_half_with_unit_sum():
    impulse = torch.zeros(1, 25, 25, 1, dtype=torch.float64)
    impulse[0, 12, 12] = 1
    response = window_mean(impulse)[0, :, :, 0]
    assert response.sum().item() == pytest.approx(1, abs=1e-12)
    assert (response[12, 14] / response[12, 12]).item() == pytest.approx(math.exp(-(2**2) / (2 * 1.5**2)))
    assert response[12, 12 + 5] > 0 and response[12, 12 + 6] == 0
    assert torch.allclose(response, response.T, atol=1e-15)


def test_window_equals_a_dense_convolution_on_images_smaller_than_itself(generator):
    images = torch.rand(2, 4, 7, 3, generator=generator, dtype=torch.float64)
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    taps = torch.exp(-(offsets**2) / 4.5)
    kernel = torch.outer(taps, taps) / taps.sum() ** 2
    channels = images.permute(0, 3, 1, 2).reshape(6, 1, 4, 7)
    dense = torch.nn.functional.conv2d(channels, kernel[None, None], padding=5)
    assert torch.allclose(window_mean(images), dense.reshape(2, 3, 4, 7).permute(0, 2, 3, 1), atol=1e-14)


@pytest.mark.parametrize("name", CASES)
def test_golden_values_and_derivative(shared, name):
    tensors, meta = load(shared, name)
    image, target = tensors["image"].requires_grad_(), tensors["target"]
    weight = pixel_weight("solid_angle", meta["height"])
    assert torch.allclose(weight[:, 0], tensors["row_weights"], atol=1e-6)
    assert torch.allclose(pixel_weight("end_rows", meta["height"])[:, 0], tensors["row_weights_end"], atol=1e-6)

    similarity = ssim_map(image, target)
    assert (similarity - tensors["ssim_map"]).abs().max() < 5e-4
    assert similarity.mean().item() == pytest.approx(meta["ssim"], abs=1e-5)

    loss = photometric_loss(image, target, weight, meta["lambda"])
    assert loss.item() == pytest.approx(meta["loss"], abs=1e-5)
    released = photometric_loss(image, target, weight, meta["lambda"], normalisation="channel_sum")
    assert released.item() == pytest.approx(meta["loss_channel_sum"], abs=1e-5)
    end_rows = pixel_weight("end_rows", meta["height"])
    released = photometric_loss(image, target, end_rows, meta["lambda"], normalisation="channel_sum")
    assert released.item() == pytest.approx(meta["loss_end_rows_channel_sum"], abs=1e-5)

    loss.backward()
    assert image.grad is not None
    valid, expected = tensors["valid_image"], tensors["grad_image"]
    assert (image.grad - expected)[valid].abs().max() < 1e-3 * expected.abs().max()


@pytest.mark.parametrize("name", CASES)
def test_golden_values_in_double_precision(shared, name):
    tensors, meta = load(shared, name, torch.float64)
    weight = pixel_weight("solid_angle", meta["height"], dtype=torch.float64)
    assert photometric_loss(tensors["image"], tensors["target"], weight).item() == pytest.approx(meta["loss"], abs=1e-8)


def test_derivative_against_finite_differences(generator):
    image = torch.rand(6, 12, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    target = torch.rand(6, 12, 3, generator=generator, dtype=torch.float64)
    mask = torch.rand(6, 12, generator=generator, dtype=torch.float64)
    weight = pixel_weight("solid_angle", 6, mask, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: photometric_loss(x, target, weight), (image,))


def test_masked_pixels_neither_count_nor_dilute(generator):
    """A constant error gives the same loss whatever part is masked, and a masked error none."""
    target = torch.rand(16, 32, 3, generator=generator)
    mask = torch.ones(16, 32)
    mask[12:] = 0
    weight = pixel_weight("solid_angle", 16, mask)
    assert photometric_loss(target + 0.1, target, weight, 1.0).item() == pytest.approx(0.1, rel=1e-5)
    spoiled = target.clone()
    spoiled[12:] += 0.7
    assert photometric_loss(spoiled, target, weight, 1.0).item() == 0


def test_rows_count_by_their_solid_angle():
    target = torch.zeros(8, 16, 3)
    image = target.clone()
    image[0] = 1  # the row next to the pole
    rows = solid_angle_weight(8)
    loss = photometric_loss(image, target, pixel_weight("solid_angle", 8), 1.0)
    assert loss.item() == pytest.approx((rows[0] / rows.sum()).item(), rel=1e-5)


def test_a_mask_that_hides_everything_is_refused():
    with pytest.raises(ValueError, match="the mask is 0 everywhere"):
        pixel_weight("uniform", 8, torch.zeros(8, 16))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_gradient_by_a_target_that_asks_for_one_is_that_of_differences(dtype, generator):
    """Float32 takes the native loss, whose derivative by the target is that by the image with both exchanged."""
    image = torch.rand(20, 24, 3, generator=generator, dtype=torch.float64).to(dtype).requires_grad_()
    target = torch.rand(20, 24, 3, generator=generator, dtype=torch.float64).to(dtype).requires_grad_()
    weight = solid_angle_weight(20, dtype=dtype)[:, None]
    loss = photometric_loss(image, target, weight)
    assert loss.item() == pytest.approx(photometric_loss(image.detach(), target.detach(), weight).item(), rel=1e-6)
    by_image, by_target = torch.autograd.grad(loss, (image, target))
    exact = [t.detach().double().requires_grad_() for t in (image, target)]
    expected = torch.autograd.grad(photometric_loss(*exact, weight.double()), exact)
    for gradient, truth in zip((by_image, by_target), expected, strict=True):
        torch.testing.assert_close(gradient.double(), truth, rtol=1e-3, atol=1e-7)
    step, place = 1e-6, (7, 11, 1)
    sides = []
    for sign in (1, -1):
        moved = exact[1].detach().clone()
        moved[place] += sign * step
        sides.append(photometric_loss(exact[0].detach(), moved, weight.double()).item())
    assert expected[1][place].item() == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=1e-4)


def test_a_mask_that_leaves_only_pixels_of_no_weight_is_refused():
    mask = torch.zeros(8, 16)
    mask[0] = 1  # whose weight is 0
    with pytest.raises(ValueError, match="the mask is 0 everywhere, or wherever pixels count"):
        pixel_weight("end_rows", 8, mask)
