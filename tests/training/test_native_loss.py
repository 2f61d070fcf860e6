"""The native loss against its definition, at sizes that fill no vector, with masks and both normalisations."""

import pytest
import torch

from padgs.native import cpu
from padgs.training import loss
from padgs.training.loss import photometric_loss, pixel_weight

pytestmark = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")


def pair(height, width):
    generator = torch.Generator().manual_seed(height * width)
    image = torch.rand(height, width, 3, generator=generator)
    return image, (image + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), generator


@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 7), (17, 33), (24, 48), (64, 130)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("normalisation", ["mean", "channel_sum"])
def test_native_matches_the_definition(height, width, masked, normalisation):
    image, target, generator = pair(height, width)
    mask = (torch.rand(height, width, generator=generator) > 0.4).float() if masked else None
    if mask is not None:
        mask[0, 0] = 1.0
    weight = pixel_weight("solid_angle", height, mask)
    values, gradients = [], []
    for dtype in (torch.float32, torch.float64):  # the native loss takes float32 only
        leaf = image.detach().to(dtype, copy=True).requires_grad_()
        value = photometric_loss(leaf, target.to(dtype), weight.to(dtype), normalisation=normalisation)
        value.backward()
        values.append(value.item())
        gradients.append(leaf.grad.double())
    assert values[0] == pytest.approx(values[1], abs=2e-6)
    assert (gradients[0] - gradients[1]).abs().max() <= 2e-5 * gradients[1].abs().max()


def test_float32_goes_to_the_native_loss(monkeypatch):
    image, target, _ = pair(8, 16)
    calls = []
    fused = loss.fused_photometric_loss
    monkeypatch.setattr(loss, "fused_photometric_loss", lambda *args: calls.append(1) or fused(*args))
    photometric_loss(image, target, pixel_weight("uniform", 8))
    photometric_loss(image.double(), target.double(), pixel_weight("uniform", 8).double())
    assert calls == [1]


def test_what_is_not_alike_never_reaches_the_library():
    image, target, _ = pair(8, 16)
    weight = pixel_weight("uniform", 8)
    for wrong in (target.double(), target[:4], target[..., :1]):
        with pytest.raises(ValueError, match=r"the target is torch.float.* the image torch.float32 of \[8, 16, 3\]"):
            loss.fused_photometric_loss(image, wrong, weight, 0.8, torch.tensor(1.0))
    with pytest.raises(ValueError, match="image, target, weight and total are on cpu, meta; bring them to one device"):
        loss.fused_photometric_loss(image, target, weight.to("meta"), 0.8, torch.tensor(1.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])  # the native loss takes float32 only
def test_hidden_pixels_have_no_part_in_the_loss(dtype):
    """SSIM windows within five pixels of a mask reach behind it."""
    image, target, generator = pair(24, 48)
    mask = (torch.rand(24, 48, generator=generator) > 0.3).float()
    mask[18:] = 0
    mask[3, 5] = 0.5
    weight = pixel_weight("solid_angle", 24, mask).to(dtype)
    image, target, hidden = image.to(dtype), target.to(dtype), mask == 0
    changed = torch.where(hidden[..., None], torch.rand(24, 48, 3, generator=generator).to(dtype), image)
    values, gradients = [], []
    for made in (image, changed):
        leaves = made.clone().requires_grad_(), target.clone().requires_grad_()
        values.append(photometric_loss(*leaves, weight, 0.2))
        gradients.append(torch.autograd.grad(values[-1], leaves))
    assert values[0] == values[1] and all(map(torch.equal, *gradients))
    assert all((gradient[hidden] == 0).all() and (gradient[~hidden] != 0).all() for gradient in gradients[0])
