"""The decoder, its native pass, and reduced precision."""

import math

import pytest
import torch
from support.decoder_cases import EVERY_SIZE, assert_matches_definition, decoded, problem
from torch import Tensor

from padgs.methods.anchors.decoder import Decoder, Head, SeenAnchors, decode_gaussians, define_gaussians
from padgs.methods.anchors.native_decoder import GRADIENT_TYPE, linear
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


each_reduced = pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)


def roundoff(dtype: torch.dtype) -> float:
    """Largest relative error of rounding to a type."""
    return torch.finfo(dtype).eps / 2


def layer(generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs [500, 37], weight [32, 37], bias [32]."""
    inputs, weight = torch.randn(500, 37, generator=generator), torch.randn(32, 37, generator=generator)
    return inputs, weight, torch.randn(32, generator=generator)


@each_reduced
def test_error_of_a_reduced_product_is_bounded_by_rounding(dtype: torch.dtype, generator):
    inputs, weight, bias = (tensor.double() for tensor in layer(generator))
    error = (linear(inputs.float(), weight.float(), bias.float(), dtype) - (inputs @ weight.T + bias)).abs()
    magnitude = inputs.abs() @ weight.T.abs() + bias.abs()
    assert (error <= 4 * roundoff(dtype) * magnitude).all()  # two operands and the result, and a bit for their products
    assert error.max() > 0.1 * roundoff(dtype) * magnitude.max()  # not float32, which would be 2^13 times as exact
    exact = (linear(inputs.float(), weight.float(), bias.float(), None) - (inputs @ weight.T + bias)).abs()
    assert exact.max() < 1e-2 * error.max()


@each_reduced
@pytest.mark.parametrize("size", [1.0, 1e-9])  # of the upstream gradient; float16 ends at 6e-8
def test_error_of_reduced_gradients_is_bounded_by_rounding_to_bfloat16(dtype: torch.dtype, size: float, generator):
    inputs, weight, bias = (tensor.requires_grad_() for tensor in layer(generator))
    upstream = size * torch.randn(500, 32, generator=generator)
    gradients = torch.autograd.grad(linear(inputs, weight, bias, dtype), (inputs, weight, bias), upstream)
    u, exact = roundoff(GRADIENT_TYPE), upstream.double()
    for gradient, a, b in zip(gradients, (exact, exact.T), (weight.double(), inputs.double()), strict=False):
        error, magnitude = (gradient - a @ b).abs(), a.abs() @ b.abs()
        assert gradient.dtype == torch.float32 and (error <= 4 * u * magnitude).all()
        assert error.max() > 1e-3 * u * magnitude.max()
    torch.testing.assert_close(gradients[2], exact.sum(0).float(), rtol=1e-5, atol=1e-5 * size)


@each_reduced
def test_error_of_reduced_networks_is_bounded_by_rounding(dtype: torch.dtype, generator):
    weights, inputs = Decoder(37, 10, generator=generator).weights(), torch.randn(400, 37, generator=generator)
    u, bounds = roundoff(dtype), []
    with torch.no_grad():
        for head in weights:
            w1, b1, w2, b2 = (tensor.double() for tensor in head)
            x = inputs.double()
            hidden = torch.relu(x @ w1.T + b1)
            hidden_error = 4 * u * (x.abs() @ w1.T.abs() + b1.abs())
            magnitude = (hidden + hidden_error) @ w2.T.abs() + b2.abs()
            bounds.append(1.01 * hidden_error @ w2.T.abs() + 3 * u * magnitude)
            assert ((head(inputs, dtype) - (hidden @ w2.T + b2)).abs() <= bounds[-1]).all()
        found, truth = weights.opacity(inputs, dtype), weights.opacity(inputs)
    sure = truth.abs() > bounds[0]
    assert sure.float().mean() > 0.5 and torch.equal(found[sure] > 0, truth[sure] > 0)
    assert not torch.equal(found, truth)


@each_reduced
def test_means_are_float32_in_reduced_precision(dtype: torch.dtype, generator: torch.Generator):
    """Means come of no network: they are those of a float32 decode, bit by bit."""
    tensors, decoder = problem(50, 10, 37, 32, generator)
    ours, slots, *_ = decoded(define_gaussians, tensors, decoder, str(dtype).removeprefix("torch."))
    truth, true_slots, *_ = decoded(define_gaussians, tensors, decoder)
    shared = slots[torch.isin(slots, true_slots)]
    assert len(shared) > 0.9 * len(true_slots) > 0
    places, true_places = torch.searchsorted(slots, shared), torch.searchsorted(true_slots, shared)
    assert torch.equal(ours.means[places], truth.means[true_places])
    for field in ("quats", "scales", "opacities", "colors"):
        values = getattr(ours, field)
        assert values.dtype == torch.float32 and not torch.equal(values[places], getattr(truth, field)[true_places])
