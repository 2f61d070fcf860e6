import pytest
import torch

import padgs.training.targets
from padgs.scene import View
from padgs.training.loss import ssim_statistics
from padgs.training.targets import Targets


def view(pixels: torch.Tensor, mask: torch.Tensor | None = None) -> View:
    load_mask = None if mask is None else (lambda: mask)
    return View("v", torch.eye(4, dtype=torch.float64), 8, 4, load_pixels=lambda: pixels, load_mask=load_mask)


@pytest.fixture(autouse=True)
def without_fused_loss(monkeypatch):
    """The native loss keeps no statistics."""
    monkeypatch.setattr(padgs.training.targets, "fits", lambda image: False)


PIXELS = torch.arange(96, dtype=torch.uint8).reshape(4, 8, 3)


def test_image_weight_and_statistics():
    mask = torch.ones(4, 8)
    mask[3] = 0
    target = Targets([view(PIXELS, mask)], "uniform")[0]
    assert torch.equal(target.image, PIXELS / 255)
    assert torch.equal(target.weight, mask)
    assert target.statistics is not None
    assert torch.equal(target.statistics.mean, ssim_statistics(PIXELS / 255).mean)


def test_moments_are_kept_only_while_there_is_room(monkeypatch):
    monkeypatch.setattr(padgs.training.targets, "CACHE_BYTES", 2 * 16 + 2 * 96 * 4)  # two weights, and statistics
    targets = Targets([view(PIXELS), view(255 - PIXELS)], "uniform")
    assert targets[0].statistics is targets[0].statistics
    assert targets[1].statistics is not targets[1].statistics


def test_the_fused_loss_needs_no_statistics(monkeypatch):
    monkeypatch.setattr(padgs.training.targets, "fits", lambda image: True)
    assert Targets([view(PIXELS)], "uniform")[0].statistics is None


def test_wrong_sizes_are_named():
    with pytest.raises(ValueError, match="image of view 'v' is 6x4; the view is 8x4"):
        Targets([view(PIXELS[:, :6])], "uniform")[0]
    with pytest.raises(ValueError, match="mask of view 'v' is 8x2; the view is 8x4"):
        Targets([view(PIXELS, torch.ones(2, 8))], "uniform")[0]


def test_a_mask_that_leaves_nothing_names_its_view():
    with pytest.raises(ValueError, match="view 'v': the mask is 0 everywhere"):
        Targets([view(PIXELS, torch.zeros(4, 8))], "solid_angle")[0]
