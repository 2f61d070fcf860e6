"""Weights of hybrid blending."""

from __future__ import annotations

import pytest
import torch
from support.definition import one_pixel
from torch import Tensor

from padgs.render.backends.torch import hybrid_weights


def random_fragments(pixels: int, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return alpha and distance [P, K]: a third not drawn, a third faint."""
    alpha = torch.rand(pixels, count, generator=generator, dtype=torch.float64)
    kind = torch.randint(3, alpha.shape, generator=generator)
    alpha = torch.where(kind == 0, 0.0, torch.where(kind == 1, 1 / 255 + 0.04 * alpha, 0.06 + 0.6 * alpha))
    return alpha, 1 + torch.rand(alpha.shape, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("size", [1, 2, 5, 16, 256])
def test_weights_match_the_published_procedure(size: int, generator: torch.Generator):
    alpha, distance = random_fragments(50, 40, generator)
    distance[:20] = (4 * distance[:20]).round()  # many ties: the first in the list is in front
    weights, left = hybrid_weights(alpha, distance, size)
    for pixel in range(len(alpha)):
        expected, transmittance = one_pixel(alpha[pixel].tolist(), distance[pixel].tolist(), size)
        torch.testing.assert_close(weights[pixel], torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-15)
        assert left[pixel].item() == pytest.approx(transmittance, rel=1e-12)


def test_weights_and_transmittance_sum_to_one(generator: torch.Generator):
    weights, left = hybrid_weights(*random_fragments(200, 60, generator), 14)
    covered = left == 0  # the core ended early and what was left, less than 1e-4, counts as nothing
    assert covered.any() and not covered.all()
    sums = weights.sum(-1) + left
    torch.testing.assert_close(sums[~covered], torch.ones_like(sums[~covered]), rtol=1e-12, atol=0)
    assert ((sums[covered] > 1 - 1e-4) & (sums[covered] <= 1)).all()


def test_nothing_lies_behind_a_core_that_ends_early():
    alpha = torch.tensor([[0.9, 0.95, 0.99, 0.5, 0.03]], dtype=torch.float64)
    weights, left = hybrid_weights(alpha, torch.tensor([[1.0, 2.0, 3.0, 4.0, 0.5]], dtype=torch.float64), 16)
    torch.testing.assert_close(weights, torch.tensor([[0.9, 0.095, 0.00495, 0.0, 0.0]], dtype=torch.float64))
    assert left.item() == 0


def test_the_tail_lies_behind_the_core():
    near_fog = hybrid_weights(torch.tensor([[0.04, 0.5]]), torch.tensor([[1.0, 2.0]]), 16)
    far_fog = hybrid_weights(torch.tensor([[0.04, 0.5]]), torch.tensor([[3.0, 2.0]]), 16)
    for weights, left in (near_fog, far_fog):
        torch.testing.assert_close(weights, torch.tensor([[0.02, 0.5]]))
        torch.testing.assert_close(left, torch.tensor([0.48]))


@pytest.mark.parametrize("size", [1, 3, 16, 64])
def test_derivatives_match_differences(size: int, generator: torch.Generator):
    alpha, distance = random_fragments(6, 9, generator)
    inside = alpha.clamp(max=0.9).requires_grad_()
    drawn = alpha > 0  # what is not drawn is 0 by definition, and stays so

    def blend(x: Tensor) -> tuple[Tensor, Tensor]:
        return hybrid_weights(torch.where(drawn, x, torch.zeros_like(x)), distance, size)

    assert torch.autograd.gradcheck(blend, inside)


def test_weights_do_not_depend_on_the_order_of_the_list(generator: torch.Generator):
    alpha, distance = random_fragments(100, 30, generator)
    weights, left = hybrid_weights(alpha, distance, 4)
    order = torch.randperm(30, generator=generator)
    permuted, permuted_left = hybrid_weights(alpha[:, order], distance[:, order], 4)
    torch.testing.assert_close(permuted, weights[:, order], rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(permuted_left, left, rtol=1e-12, atol=0)


def test_without_fragments_transmittance_is_one():
    weights, left = hybrid_weights(torch.zeros(3, 0), torch.zeros(3, 0), 16)
    assert weights.shape == (3, 0) and torch.equal(left, torch.ones(3))
    weights, left = hybrid_weights(torch.zeros(3, 2), torch.ones(3, 2), 16)
    assert not weights.any() and torch.equal(left, torch.ones(3))
