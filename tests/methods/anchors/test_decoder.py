"""The three networks: shapes, order of their outputs, and that skipping work changes nothing."""

import math

import pytest
import torch

from padgs.methods.anchors.decoder import Decoder, Head, decode, take_rows


@pytest.fixture
def decoder(generator) -> Decoder:
    return Decoder(37, 10, generator=generator).double()


@pytest.fixture
def inputs(generator):
    return torch.randn(40, 37, generator=generator, dtype=torch.float64)


def test_published_shapes(decoder):
    shapes = {
        head: [tuple(weight.shape) for weight in getattr(decoder.weights(), head)]
        for head in ("opacity", "color", "covariance")
    }
    hidden = [(32, 37), (32,)]
    assert shapes == {
        "opacity": [*hidden, (10, 32), (10,)],
        "color": [*hidden, (30, 32), (30,)],
        "covariance": [*hidden, (70, 32), (70,)],
    }
    assert sum(weight.numel() for weight in decoder.parameters()) == 7278


def test_initial_weights_are_those_of_torch_linear(decoder):
    for weights, fan_in in (
        (decoder.opacity["w1"], 37),
        (decoder.covariance["b1"], 37),
        (decoder.covariance["w2"], 32),
    ):
        bound = 1 / math.sqrt(fan_in)
        assert 0.8 * bound < weights.abs().max() <= bound
        assert weights.var().item() == pytest.approx(bound**2 / 3, rel=0.5)


def test_outputs_belong_to_gaussian_k_of_their_anchor(decoder, inputs):
    """Every selected Gaussian against the networks evaluated plainly, one anchor at a time."""
    weights = decoder.weights()
    said = decode(weights, inputs)
    row = 0
    for anchor, x in enumerate(inputs):
        opacity, color, covariance = (
            head.w2 @ torch.relu(head.w1 @ x + head.b1) + head.b2
            for head in (weights.opacity, weights.color, weights.covariance)
        )
        assert torch.allclose(said.raw_opacities[anchor], torch.tanh(opacity))
        for k in range(10):
            if opacity[k] <= 0:
                continue
            assert said.slots[row] == anchor * 10 + k
            assert torch.allclose(said.opacities[row], torch.tanh(opacity[k]))
            assert torch.allclose(said.colors[row], torch.sigmoid(color[3 * k : 3 * k + 3]))
            assert torch.allclose(said.shrinkage[row], torch.sigmoid(covariance[7 * k : 7 * k + 3]))
            assert torch.allclose(said.quats[row], covariance[7 * k + 3 : 7 * k + 7])
            row += 1
    assert row == len(said.slots) > 0


def test_leaving_out_dead_anchors_changes_no_value_and_no_gradient(decoder, inputs):
    """Half the anchors are made dead; decoding the living ones alone must give the same."""
    with torch.no_grad():
        decoder.opacity["w1"][0] = 0
        decoder.opacity["w1"][0, 0] = 1000.0
        decoder.opacity["w2"][:, 0] = -1.0  # a large first input makes all opacities negative
    inputs[::2, 0] = 1.0
    inputs[1::2, 0] = -1.0
    outcomes = []
    for rows in (inputs, inputs[1::2]):
        decoder.zero_grad()
        rows = rows.clone().requires_grad_()
        said = decode(decoder.weights(), rows)
        (said.opacities.sum() + said.colors.square().sum() + said.shrinkage.sum() + said.quats.sin().sum()).backward()
        outcomes.append((said, rows.grad, [weight.grad.clone() for weight in decoder.parameters()]))
    (whole, whole_grad, whole_weights), (part, part_grad, part_weights) = outcomes
    assert (whole.raw_opacities[::2] < 0).all() and len(part.slots) > 0
    for name in ("opacities", "colors", "shrinkage", "quats"):
        assert torch.allclose(getattr(whole, name), getattr(part, name))
    assert torch.allclose(whole_grad[1::2], part_grad) and (whole_grad[::2] == 0).all()
    assert all(torch.allclose(a, b) for a, b in zip(whole_weights, part_weights, strict=True))


def test_nothing_selected(decoder, inputs):
    with torch.no_grad():
        decoder.opacity["b2"].fill_(-100.0)
    said = decode(decoder.weights(), inputs)
    assert [len(part) for part in said] == [40, 0, 0, 0, 0, 0] and said.quats.shape == (0, 4)
    (said.opacities.sum() + said.colors.sum() + said.quats.sum()).backward()
    assert all(torch.isfinite(weight.grad).all() for weight in decoder.parameters() if weight.grad is not None)


def test_take_rows_is_indexing(generator):
    table = torch.randn(7, 3, generator=generator)
    rows = torch.tensor([6, 0, 0, 3])
    assert torch.equal(take_rows(table, rows), table[rows])


def test_gradients_match_finite_differences(generator):
    head = Head(
        *(
            torch.randn(s, generator=generator, dtype=torch.float64).requires_grad_()
            for s in ((5, 4), (5,), (3, 5), (3,))
        )
    )
    inputs = torch.randn(6, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda *args: Head(*args[1:])(args[0]), (inputs, *head))
