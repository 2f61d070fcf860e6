"""The GPU's photometric loss against its definition in float64; on the GPU or emulated."""

import pytest
import torch
from support import cuda_engine

from padgs.training import loss as training_loss
from padgs.training.loss import fused_photometric_loss, photometric_loss, pixel_weight

pytestmark = [*cuda_engine.marks()]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"


@pytest.fixture(autouse=True)
def emulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """The emulation works on tensors of the CPU."""
    monkeypatch.setitem(training_loss.EVALUATIONS, DEVICE, training_loss.EVALUATIONS["cuda"])


@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 7), (17, 33), (24, 48), (50, 70)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("lambda_l1", [0.8, 0.0, 1.0])
def test_the_gpu_matches_the_definition(height: int, width: int, masked: bool, lambda_l1: float, generator):
    image = torch.rand(height, width, 3, generator=generator)
    target = (image + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)
    if height > 1:
        target[0, 0] = image[0, 0]  # where the absolute value has no derivative
    mask = (torch.rand(height, width, generator=generator) > 0.4).float() if masked else None
    if mask is not None:
        mask[0, 0] = 1.0
        image = torch.where(mask[..., None] > 0, image, target)  # as `photometric_loss` fills hidden pixels
    weight = pixel_weight("solid_angle", height, mask)
    exact = image.double().requires_grad_()
    expected = photometric_loss(exact, target.double(), weight.double(), lambda_l1=lambda_l1)
    expected.backward()

    leaf = image.to(DEVICE).requires_grad_()
    total = 3 * weight.expand(height, width).sum().to(DEVICE)
    value = fused_photometric_loss(leaf, target.to(DEVICE), weight.to(DEVICE), lambda_l1, total)
    (2 * value).backward()
    assert exact.grad is not None and leaf.grad is not None
    assert value.item() == pytest.approx(expected.item(), abs=2e-6)
    visible = (weight > 0).expand(height, width)
    difference = (leaf.grad.cpu().double() / 2 - exact.grad)[visible]
    assert difference.abs().max() <= 2e-5 * exact.grad.abs().max()


def test_without_a_gradient_none_is_computed(generator: torch.Generator):
    image, target = torch.rand(2, 20, 30, 3, generator=generator).to(DEVICE)
    weight = torch.ones(20, 1, device=DEVICE)
    total = torch.tensor(1800.0, device=DEVICE)
    leaf = image.clone().requires_grad_()
    values = [fused_photometric_loss(x, target, weight, 0.8, total) for x in (image, leaf)]
    assert torch.equal(values[0], values[1]) and not values[0].requires_grad
