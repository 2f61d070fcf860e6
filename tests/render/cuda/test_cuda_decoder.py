"""Decoding on the GPU against its definition: values and gradients; on the GPU or emulated."""

from __future__ import annotations

import cuda_engine
import pytest
import torch
from torch import Tensor

from padgs.anchors.decoder import (
    Decoder,
    DecoderWeights,
    SeenAnchors,
    decode_gaussians,
    decode_padded,
    define_gaussians,
)
from padgs.anchors.gpu_decoder import decode_on_gpu
from padgs.anchors.precision import OF_GRADIENTS, reduced
from padgs.gaussians import Gaussians

pytestmark = [*cuda_engine.marks()]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"
LEARNED = ("features", "offsets", "log_scales")


def on_gpu(
    weights: DecoderWeights, anchors: SeenAnchors, precision: str = "float32"
) -> tuple[Gaussians, Tensor, Tensor]:
    """What `decode_gaussians` does with tensors of a GPU."""
    if cuda_engine.ON_GPU:
        return decode_gaussians(weights, anchors, precision)
    flat = tuple(tensor for head in weights for tensor in head)
    *values, slots, raw = decode_on_gpu(flat, *anchors, dtype=reduced(precision))
    return Gaussians(*values), slots, raw


def decoded(
    function, tensors: dict[str, Tensor], decoder: Decoder, precision: str = "float32"
) -> tuple[Gaussians, Tensor, Tensor, dict]:
    leaves = {name: tensor.clone().requires_grad_(name in LEARNED) for name, tensor in tensors.items()}
    gaussians, slots, raw = function(decoder.weights(), SeenAnchors(**leaves), precision)
    generator = torch.Generator().manual_seed(0)
    values = list(vars(gaussians).values())
    upstream = [torch.randn(value.shape, generator=generator).to(value) for value in values]
    learned = {name: leaves[name] for name in LEARNED} | dict(decoder.named_parameters())
    gradients = torch.autograd.grad(values, list(learned.values()), upstream)
    return gaussians, slots, raw, dict(zip(learned, gradients, strict=True))


def problem(anchors: int, offsets: int, inputs: int, hidden: int, generator) -> tuple[dict[str, Tensor], Decoder]:
    decoder = Decoder(inputs, offsets, hidden, generator=generator).to(DEVICE)
    with torch.no_grad():
        decoder.opacity["b2"] += 0.1
    shapes = {"features": (32,), "seen": (inputs - 32,), "positions": (3,), "offsets": (offsets, 3)}
    tensors = {name: torch.randn(anchors, *shape, generator=generator) for name, shape in shapes.items()}
    tensors["log_scales"] = 0.3 * torch.randn(anchors, 6, generator=generator) - 1
    tensors["attenuation"] = 0.9 * torch.rand(anchors, generator=generator) + 0.1
    return {name: tensor.to(DEVICE) for name, tensor in tensors.items()}, decoder


@pytest.mark.parametrize("anchors", [1, 17, 300])
@pytest.mark.parametrize(("offsets", "inputs", "hidden"), [(10, 37, 32), (1, 36, 16), (3, 37, 32)])
def test_the_gpu_matches_the_definition(anchors: int, offsets: int, inputs: int, hidden: int, generator):
    tensors, decoder = problem(anchors, offsets, inputs, hidden, generator)
    ours, slots, raw, gradients = decoded(on_gpu, tensors, decoder)
    truth, true_slots, true_raw, true_gradients = decoded(define_gaussians, tensors, decoder)
    assert torch.equal(slots, true_slots)
    torch.testing.assert_close(raw, true_raw, atol=2e-6, rtol=0)
    for name, value in vars(truth).items():
        torch.testing.assert_close(getattr(ours, name), value, atol=5e-6, rtol=1e-5)
    for name, expected in true_gradients.items():
        limit = 2e-5 * expected.abs().max().clamp(min=1e-6)
        assert (gradients[name] - expected).abs().max() <= limit, name
        assert expected.any() or anchors == 1, name


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_reduced_precisions_match_the_definition_and_stay_near_float32(precision: str, generator: torch.Generator):
    tensors, decoder = problem(300, 10, 37, 32, generator)
    with torch.no_grad():  # opacities away from the threshold, so that rounding selects nobody else
        decoder.opacity["b2"] += 4
    ours, slots, raw, gradients = decoded(on_gpu, tensors, decoder, precision)
    assert all(value.dtype == torch.float32 for value in (raw, *vars(ours).values(), *gradients.values()))
    u, u_of_gradients = (torch.finfo(dtype or torch.float32).eps / 2 for dtype in (reduced(precision), OF_GRADIENTS))
    flips = (4 * u) ** 0.5  # of the norm: near enough to 0, a share of some u of the hidden units changes sides
    for their_precision, limit, of_gradients in (
        (precision, 8 * u, 8 * u_of_gradients),  # sums in another order may be rounded to the number beside
        ("float32", 16 * u, 8 * u_of_gradients + flips),
    ):
        truth, true_slots, true_raw, true_gradients = decoded(define_gaussians, tensors, decoder, their_precision)
        assert torch.equal(slots, true_slots) and (raw - true_raw).abs().max() < limit
        for name, value in vars(truth).items():
            assert (getattr(ours, name) - value).norm() < limit * value.norm(), name
        for name, expected in true_gradients.items():
            assert (gradients[name] - expected).norm() < of_gradients * expected.norm(), name
    exact = on_gpu(decoder.weights(), SeenAnchors(**tensors))[0]
    assert torch.equal(ours.means, exact.means) and not torch.equal(ours.colors, exact.colors)


def test_padded_decoding_is_the_same_with_zeros_behind(generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)
    exact = on_gpu(decoder.weights(), SeenAnchors(**tensors))[0]
    padded = decode_padded(decoder.weights(), SeenAnchors(**tensors))
    count = len(exact)
    assert 0 < count < len(padded) == 600
    for name, value in vars(exact).items():
        assert torch.equal(getattr(padded, name)[:count], value) and not getattr(padded, name)[count:].any(), name


def test_padded_decoding_elsewhere_is_refused(generator: torch.Generator):
    tensors, decoder = problem(3, 10, 37, 32, generator)
    with pytest.raises(ValueError, match="only a GPU decodes without counting, and float32; got torch.float64 on "):
        decode_padded(decoder.weights(), SeenAnchors(*(tensor.double() for tensor in tensors.values())))


def test_nothing_selected_is_no_gaussians(generator: torch.Generator):
    decoder = Decoder(36, 10, generator=generator).to(DEVICE)
    with torch.no_grad():
        decoder.opacity["b2"] -= 50
    shapes = {
        "features": (32,),
        "seen": (4,),
        "positions": (3,),
        "offsets": (10, 3),
        "log_scales": (6,),
        "attenuation": (),
    }
    tensors = {name: torch.zeros(9, *shape, device=DEVICE) for name, shape in shapes.items()}
    gaussians, slots, raw = on_gpu(decoder.weights(), SeenAnchors(**tensors))
    assert len(gaussians) == len(slots) == 0 and (raw < 0).all()
