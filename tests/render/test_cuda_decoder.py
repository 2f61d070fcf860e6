"""Decoding on the GPU against its definition: values and gradients; on the GPU or emulated."""

from __future__ import annotations

import cuda_engine
import pytest
import torch
from torch import Tensor

from padgs.decoder import Decoder, DecoderWeights, decode_gaussians, define_gaussians
from padgs.gaussians import Gaussians
from padgs.gpu_decoder import decode_on_gpu

pytestmark = [*cuda_engine.marks()]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"
LEARNED = ("features", "offsets", "log_scales")


def on_gpu(weights: DecoderWeights, **tensors: Tensor) -> tuple[Gaussians, Tensor, Tensor]:
    """What `decode_gaussians` does with tensors of a GPU."""
    if cuda_engine.ON_GPU:
        return decode_gaussians(weights, **tensors)
    *values, slots, raw = decode_on_gpu(tuple(tensor for head in weights for tensor in head), *tensors.values())
    return Gaussians(*values), slots, raw


def decoded(function, tensors: dict[str, Tensor], decoder: Decoder) -> tuple[Gaussians, Tensor, Tensor, dict]:
    leaves = {name: tensor.clone().requires_grad_(name in LEARNED) for name, tensor in tensors.items()}
    decoder.zero_grad()
    gaussians, slots, raw = function(decoder.weights(), **leaves)
    generator = torch.Generator().manual_seed(0)
    values = vars(gaussians).values()
    sum((value * torch.randn(value.shape, generator=generator).to(value)).sum() for value in values).backward()
    gradients = {name: leaves[name].grad for name in LEARNED}
    return gaussians, slots, raw, gradients | {name: p.grad.clone() for name, p in decoder.named_parameters()}


@pytest.mark.parametrize("anchors", [1, 17, 300])
@pytest.mark.parametrize(("offsets", "inputs", "hidden"), [(10, 37, 32), (1, 36, 16), (3, 37, 32)])
def test_the_gpu_matches_the_definition(anchors: int, offsets: int, inputs: int, hidden: int, generator):
    decoder = Decoder(inputs, offsets, hidden, generator=generator).to(DEVICE)
    with torch.no_grad():
        decoder.opacity["b2"] += 0.1
    shapes = {"features": (32,), "seen": (inputs - 32,), "positions": (3,), "offsets": (offsets, 3)}
    tensors = {name: torch.randn(anchors, *shape, generator=generator) for name, shape in shapes.items()}
    tensors["log_scales"] = 0.3 * torch.randn(anchors, 6, generator=generator) - 1
    tensors["attenuation"] = 0.9 * torch.rand(anchors, generator=generator) + 0.1
    tensors = {name: tensor.to(DEVICE) for name, tensor in tensors.items()}
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
    gaussians, slots, raw = on_gpu(decoder.weights(), **tensors)
    assert len(gaussians) == len(slots) == 0 and (raw < 0).all()
