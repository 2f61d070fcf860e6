from collections import Counter
from dataclasses import replace

import pytest
import torch

import padgs.training.targets
from padgs.scene import Scene, View
from padgs.training.options import TrainOptions
from padgs.training.targets import Target, Targets, TrainingViews

PIXELS = torch.arange(96, dtype=torch.uint8).reshape(4, 8, 3)


def view(pixels: torch.Tensor, mask: torch.Tensor | None = None) -> View:
    load_mask = None if mask is None else (lambda: mask)
    return View("v", torch.eye(4, dtype=torch.float64), 8, 4, load_pixels=lambda: pixels, load_mask=load_mask)


def test_image_and_weight():
    mask = torch.ones(4, 8)
    mask[3] = 0
    target = Targets([view(PIXELS, mask)], "uniform").at(0)[1]
    assert torch.equal(target.image, PIXELS / 255)
    assert torch.equal(target.weight, mask)


def test_weights_are_kept_only_while_there_is_room(monkeypatch):
    monkeypatch.setattr(padgs.training.targets, "CACHE_BYTES", 16)  # one weight
    targets = Targets([view(PIXELS), view(255 - PIXELS)], "uniform")
    assert targets.at(0)[1].weight is targets.at(0)[1].weight
    assert targets.at(1)[1].weight is not targets.at(1)[1].weight


@pytest.mark.parametrize(
    ("pixels", "mask", "message"),
    [
        (PIXELS[:, :6], None, "image of view 'v' is 6x4; the view is 8x4"),
        (PIXELS, torch.ones(2, 8), "mask of view 'v' is 8x2; the view is 8x4"),
        (PIXELS, torch.zeros(4, 8), "view 'v': the mask is 0 everywhere"),
    ],
)
def test_unusable_pixels_are_named(pixels, mask, message):
    with pytest.raises(ValueError, match=message):
        Targets([view(pixels, mask)], "solid_angle").at(0)


def test_views_are_drawn_by_their_share():
    views = tuple(replace(view(PIXELS), share=share) for share in (1.0, 1.0, 0.25, 0.05))
    order = TrainingViews(Scene("s", views, (), torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8), ""))
    drawn = Counter(order.next(1.0)[0] for _ in range(4600))  # 2000 passes of 2.3 views
    assert abs(drawn[0] - drawn[1]) <= 1 and abs(drawn[0] - 2000) < 60
    assert abs(drawn[2] - 500) < 80 and abs(drawn[3] - 100) < 45, "within 4 standard deviations"
    alone = TrainingViews(Scene("s", views[3:], (), torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8), ""))
    assert alone.next(1.0)[0] == 0


@pytest.mark.parametrize("masked", [False, True])
def test_squared_errors_count_at_the_end_of_a_run(generator, masked):
    image, target = torch.rand(2, 16, 32, 3, generator=generator).unbind()
    weight = torch.rand(16, 32 if masked else 1, generator=generator)
    if masked:
        weight[:, :5], image[:, :5] = 0.0, 7.0
    options, plain = TrainOptions(square_weight=3.0), TrainOptions()
    found = Target(target, weight)
    squares = (weight[..., None] * (image - target).square()).sum() / (3 * weight.expand(16, 32).sum())
    assert found.squares(image, plain, 1.0) == found.squares(image, options, 0.6) == 0
    assert found.squares(image, options, 0.61).item() == pytest.approx(3 * squares.item(), rel=1e-5)


def test_black_pixels_keep_black_behind_them():
    photograph = torch.zeros(2, 4, 3)
    photograph[0, :, 1] = 0.5
    transmittance = torch.full((2, 4), 0.25, requires_grad=True)
    color = [0.0, 0.4, 1.0]
    seen = Target(photograph, torch.ones(2, 1)).with_background(torch.zeros(2, 4, 3), transmittance, color)
    assert torch.allclose(seen[0], torch.tensor([0.0, 0.1, 0.25])) and not seen[1].any()
    seen.sum().backward()
    assert torch.allclose(transmittance.grad, torch.tensor([[1.4], [0.0]]).expand(2, 4))
