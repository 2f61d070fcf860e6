"""Products in a reduced_dtype type: within the bounds that its rounding has, and truly reduced_dtype."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from padgs.methods.anchors.decoder import Decoder, SeenAnchors, decode, define_gaussians
from padgs.methods.anchors.precision import GRADIENT_TYPE, linear, reduced_dtype

each_reduced = pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)


def roundoff(dtype: torch.dtype) -> float:
    """Largest relative error of rounding to a type."""
    return torch.finfo(dtype).eps / 2


def layer(generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs [500, 37], weight [32, 37], bias [32]."""
    inputs, weight = torch.randn(500, 37, generator=generator), torch.randn(32, 37, generator=generator)
    return inputs, weight, torch.randn(32, generator=generator)


@each_reduced
def test_a_product_errs_by_the_rounding_of_its_operands_and_its_result(dtype: torch.dtype, generator):
    inputs, weight, bias = (tensor.double() for tensor in layer(generator))
    error = (linear(inputs.float(), weight.float(), bias.float(), dtype) - (inputs @ weight.T + bias)).abs()
    magnitude = inputs.abs() @ weight.T.abs() + bias.abs()
    assert (error <= 4 * roundoff(dtype) * magnitude).all()  # two operands and the result, and a bit for their products
    assert error.max() > 0.1 * roundoff(dtype) * magnitude.max()  # not float32, which would be 2^13 times as exact
    exact = (linear(inputs.float(), weight.float(), bias.float(), None) - (inputs @ weight.T + bias)).abs()
    assert exact.max() < 1e-2 * error.max()


@each_reduced
@pytest.mark.parametrize("size", [1.0, 1e-9])  # of the upstream gradient; float16 ends at 6e-8
def test_gradients_are_float32_and_err_by_the_rounding_of_bfloat16(dtype: torch.dtype, size: float, generator):
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
def test_networks_err_by_rounding_alone_and_select_the_same_but_at_the_threshold(dtype: torch.dtype, generator):
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
        said, truth = decode(weights, inputs, dtype), decode(weights, inputs)
    sure = torch.atanh(truth.raw_opacities).abs() > bounds[0]
    assert sure.float().mean() > 0.5 and torch.equal(said.raw_opacities[sure] > 0, truth.raw_opacities[sure] > 0)
    assert not torch.equal(said.raw_opacities, truth.raw_opacities)


@each_reduced
def test_geometry_stays_float32(dtype: torch.dtype, generator: torch.Generator):
    """Means come of no network: they are those of a float32 decode, bit by bit."""
    decoder, k = Decoder(37, 10, generator=generator), 10
    shapes = ((32,), (5,), (3,), (k, 3), (6,))
    features, seen, positions, offsets, log_scales = (torch.randn(50, *s, generator=generator) for s in shapes)
    attenuation = torch.rand(50, generator=generator)
    anchors = SeenAnchors(features, seen, positions, offsets, log_scales, attenuation)
    ours, slots, _ = define_gaussians(decoder.weights(), anchors, str(dtype).removeprefix("torch."))
    truth, true_slots, _ = define_gaussians(decoder.weights(), anchors)
    shared = slots[torch.isin(slots, true_slots)]
    assert len(shared) > 0.9 * len(true_slots) > 0
    places, true_places = torch.searchsorted(slots, shared), torch.searchsorted(true_slots, shared)
    assert torch.equal(ours.means[places], truth.means[true_places])
    for field in ("quats", "scales", "opacities", "colors"):
        values = getattr(ours, field)
        assert values.dtype == torch.float32 and not torch.equal(values[places], getattr(truth, field)[true_places])


def test_unknown_names_list_the_known():
    with pytest.raises(ValueError, match="unknown precision 'half'; known: float32, bfloat16, float16"):
        reduced_dtype("half")
