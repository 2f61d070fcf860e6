"""The decoder and its native pass."""

import math

import pytest
import torch
from support.decoder_cases import EVERY_SIZE, assert_matches_definition, decoded, problem

from padgs.methods.anchors.decoder import Decoder, Head, SeenAnchors, decode_gaussians, define_gaussians
from padgs.native import cpu


@pytest.fixture
def decoder(generator) -> Decoder:
    return Decoder(37, 10, generator=generator).double()


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
    covariance = decoder.covariance
    for weights, fan_in in ((decoder.opacity["w1"], 37), (covariance["b1"], 37), (covariance["w2"], 32)):
        bound = 1 / math.sqrt(fan_in)
        assert 0.8 * bound < weights.abs().max() <= bound
        assert weights.var().item() == pytest.approx(bound**2 / 3, rel=0.5)


def test_outputs_match_networks_evaluated_one_anchor_at_a_time(generator):
    """Every selected Gaussian against the networks evaluated plainly, one anchor at a time."""
    tensors, decoder = problem(40, 10, 37, 32, generator)
    weights, row = decoder.weights(), 0
    found, slots, raw_opacities = define_gaussians(weights, SeenAnchors(**tensors))
    for anchor, x in enumerate(torch.cat((tensors["features"], tensors["seen"]), dim=-1)):
        opacity, color, covariance = (head.w2 @ torch.relu(head.w1 @ x + head.b1) + head.b2 for head in weights)
        reach, size = tensors["log_scales"][anchor].exp().split(3)
        assert torch.allclose(raw_opacities[anchor], torch.tanh(opacity), atol=1e-6)
        for k in (opacity > 0).nonzero()[:, 0].tolist():
            expected = {
                "means": tensors["positions"][anchor] + reach * tensors["offsets"][anchor, k],
                "opacities": torch.tanh(opacity[k]) * tensors["attenuation"][anchor],
                "colors": torch.sigmoid(color[3 * k : 3 * k + 3]),
                "scales": size * torch.sigmoid(covariance[7 * k : 7 * k + 3]),
                "quats": covariance[7 * k + 3 : 7 * k + 7],
            }
            assert slots[row] == anchor * 10 + k
            for name, value in expected.items():
                assert torch.allclose(getattr(found, name)[row], value, atol=1e-5), name
            row += 1
    assert row == len(slots) > 0


def test_gradients_match_finite_differences(generator):
    sizes = ((6, 4), (5, 4), (5,), (3, 5), (3,))
    inputs, *head = (torch.randn(s, generator=generator, dtype=torch.float64, requires_grad=True) for s in sizes)
    assert torch.autograd.gradcheck(lambda x, *weights: Head(*weights)(x), (inputs, *head))


pytestmark = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")


@pytest.mark.parametrize("anchors", [1, 15, 17, 70, 1025])
@pytest.mark.parametrize(("offsets", "inputs", "hidden"), EVERY_SIZE)
def test_native_matches_the_definition(anchors, offsets, inputs, hidden, generator):
    assert_matches_definition(decode_gaussians, *problem(anchors, offsets, inputs, hidden, generator))


@pytest.mark.parametrize("function", [decode_gaussians, define_gaussians])
@pytest.mark.parametrize(("bias", "share"), [(-50.0, 0), (50.0, 1)])
def test_nothing_and_everything_selected(bias, share, function, generator):
    tensors, decoder = problem(33, 10, 37, 32, generator, bias=bias)
    gaussians, slots, _, gradients = decoded(function, tensors, decoder)
    assert len(slots) == len(gaussians) == share * 330
    assert all(torch.isfinite(gradient).all() for gradient in gradients.values())


def test_results_are_bit_equal_for_any_number_of_threads(generator):
    tensors, decoder = problem(2500, 10, 37, 32, generator)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            gaussians, _, _, gradients = decoded(decode_gaussians, tensors, decoder)
            results.append([*vars(gaussians).values(), *gradients.values()])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
