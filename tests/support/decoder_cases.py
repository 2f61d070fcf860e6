"""Random anchors with their networks, and native decoders against the definition."""

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.anchors.decoder import Decoder, SeenAnchors, define_gaussians

LEARNED = ("features", "offsets", "log_scales")
EVERY_SIZE = [(10, 37, 32), (10, 35, 32), (1, 36, 16), (3, 37, 32)]  # offsets, inputs, hidden units


def problem(
    anchors: int, offsets: int, inputs: int, hidden: int, generator, *, bias: float = 0.1, device: str = "cpu"
) -> tuple[dict[str, Tensor], Decoder]:
    """Return the fields of `SeenAnchors` and networks; `bias` is added to the raw opacities."""
    decoder = Decoder(inputs, offsets, hidden, generator=generator).to(device)
    with torch.no_grad():
        decoder.opacity["b2"] += bias
    shapes = {"features": (32,), "seen": (inputs - 32,), "positions": (3,), "offsets": (offsets, 3)}
    tensors = {name: torch.randn(anchors, *shape, generator=generator) for name, shape in shapes.items()}
    tensors["log_scales"] = 0.3 * torch.randn(anchors, 6, generator=generator) - 1
    tensors["attenuation"] = 0.9 * torch.rand(anchors, generator=generator) + 0.1
    return {name: tensor.to(device) for name, tensor in tensors.items()}, decoder


def decoded(function, tensors: dict[str, Tensor], decoder: Decoder) -> tuple[Gaussians, Tensor, Tensor, dict]:
    """Return Gaussians, slots, raw opacities, and the gradients of randomly weighted outputs."""
    leaves = {name: tensor.clone().requires_grad_(name in LEARNED) for name, tensor in tensors.items()}
    gaussians, slots, raw, *_ = function(decoder.weights(), SeenAnchors(**leaves))
    generator = torch.Generator().manual_seed(0)
    values = list(vars(gaussians).values())
    upstream = [torch.randn(value.shape, generator=generator).to(value) for value in values]
    learned = {name: leaves[name] for name in LEARNED} | dict(decoder.named_parameters())
    gradients = torch.autograd.grad(values, list(learned.values()), upstream)
    return gaussians, slots, raw, dict(zip(learned, gradients, strict=True))


def assert_matches_definition(function, tensors: dict[str, Tensor], decoder: Decoder) -> None:
    """Compare float32 values and gradients with `define_gaussians`."""
    ours, slots, raw, gradients = decoded(function, tensors, decoder)
    truth, true_slots, true_raw, true_gradients = decoded(define_gaussians, tensors, decoder)
    assert torch.equal(slots, true_slots)
    torch.testing.assert_close(raw, true_raw, atol=2e-6, rtol=0)
    for name, value in vars(truth).items():
        torch.testing.assert_close(getattr(ours, name), value, atol=5e-6, rtol=1e-5)
    for name, expected in true_gradients.items():
        limit = 2e-5 * expected.abs().max().clamp(min=1e-6)
        assert (gradients[name] - expected).abs().max() <= limit, name
        assert expected.any() or len(raw) == 1, name
