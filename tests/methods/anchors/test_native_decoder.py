"""The native decoder against its definition: values and gradients, also where lanes and blocks are not full."""

import pytest
import torch

from padgs.methods.anchors.decoder import Decoder, SeenAnchors, decode_gaussians, define_gaussians
from padgs.native import cpu

pytestmark = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")
OUTPUTS = ("means", "quats", "scales", "opacities", "colors")


def decoded(function, tensors, decoder, generator_seed=0):
    """Outputs, slots, raw opacities, and gradients of a random weighting of the outputs."""
    leaves = {
        name: tensor.clone().requires_grad_(name in ("features", "offsets", "log_scales"))
        for name, tensor in tensors.items()
    }
    decoder.zero_grad()
    gaussians, slots, raw = function(decoder.weights(), SeenAnchors(**leaves))
    generator = torch.Generator().manual_seed(generator_seed)
    loss = sum(
        (getattr(gaussians, name) * torch.randn(getattr(gaussians, name).shape, generator=generator)).sum()
        for name in OUTPUTS
    )
    if len(slots):
        loss.backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.requires_grad}
    return gaussians, slots, raw, gradients | {name: p.grad for name, p in decoder.named_parameters()}


def problem(anchors, offsets, inputs, hidden, opacity_bias=0.0):
    generator = torch.Generator().manual_seed(anchors + offsets)
    decoder = Decoder(inputs, offsets, hidden, generator=generator)
    with torch.no_grad():
        decoder.opacity["b2"] += opacity_bias
    features = min(32, inputs - 3)
    sizes = {"features": (features,), "seen": (inputs - features,), "positions": (3,), "offsets": (offsets, 3)}
    tensors = {name: torch.randn(anchors, *size, generator=generator) for name, size in sizes.items()}
    tensors["log_scales"] = torch.randn(anchors, 6, generator=generator) * 0.3 - 1
    tensors["attenuation"] = torch.rand(anchors, generator=generator) * 0.9 + 0.1
    return tensors, decoder


@pytest.mark.parametrize("anchors", [1, 15, 17, 70, 1025])
@pytest.mark.parametrize(("offsets", "inputs", "hidden"), [(10, 37, 32), (10, 35, 32), (1, 36, 16), (3, 37, 32)])
def test_native_matches_the_definition(anchors, offsets, inputs, hidden):
    tensors, decoder = problem(anchors, offsets, inputs, hidden)
    ours, slots, raw, gradients = decoded(decode_gaussians, tensors, decoder)
    truth, true_slots, true_raw, true_gradients = decoded(define_gaussians, tensors, decoder)
    assert torch.equal(slots, true_slots)
    assert torch.allclose(raw, true_raw, atol=2e-6)
    for name in OUTPUTS:
        assert torch.allclose(getattr(ours, name), getattr(truth, name), atol=5e-6, rtol=1e-5), name
    for name, expected in true_gradients.items():
        if expected is None:
            continue
        assert expected.abs().max() > 0 or anchors == 1, name
        assert (gradients[name] - expected).abs().max() <= 2e-5 * expected.abs().max().clamp(min=1e-6), name


@pytest.mark.parametrize(("bias", "share"), [(-50.0, 0), (50.0, 1)])
def test_nothing_and_everything_selected(bias, share):
    tensors, decoder = problem(33, 10, 37, 32, opacity_bias=bias)
    gaussians, slots, _, _ = decoded(decode_gaussians, tensors, decoder)
    assert len(slots) == len(gaussians) == share * 330


def test_threads_change_no_bit():
    tensors, decoder = problem(2500, 10, 37, 32)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            gaussians, _, _, gradients = decoded(decode_gaussians, tensors, decoder)
            results.append(
                [getattr(gaussians, name).detach().clone() for name in OUTPUTS]
                + [g.clone() for g in gradients.values()]
            )
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
