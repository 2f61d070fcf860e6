"""Decoding on the GPU against its definition: values and gradients; on the GPU or emulated."""

from __future__ import annotations

from contextlib import contextmanager

import pytest
import torch
from support import cuda_engine
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.anchors import native_decoder
from padgs.methods.anchors.decoder import (
    Decoder,
    DecoderWeights,
    SeenAnchors,
    decode_gaussians,
    decode_with_capacity,
    define_gaussians,
)
from padgs.methods.anchors.native_decoder import decode_on_gpu
from padgs.methods.anchors.precision import GRADIENT_TYPE, PRECISIONS, reduced_dtype
from padgs.native.loading import call_hook

pytestmark = [*cuda_engine.marks()]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"
LEARNED = ("features", "offsets", "log_scales")


def on_gpu(
    weights: DecoderWeights, anchors: SeenAnchors, precision: str = "float32"
) -> tuple[Gaussians, Tensor, Tensor]:
    """Decode as `decode_gaussians` does for tensors of a GPU."""
    if cuda_engine.ON_GPU:
        return decode_gaussians(weights, anchors, precision)
    flat = tuple(tensor for head in weights for tensor in head)
    *values, slots, raw, _ = decode_on_gpu(flat, *anchors, dtype=reduced_dtype(precision))
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


@pytest.mark.parametrize("part", [100, 128])
def test_products_in_parts_sum_up_to_the_whole(part: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch):
    tensors, decoder = problem(300, 10, 37, 32, generator)
    whole = decoded(on_gpu, tensors, decoder)[3]
    monkeypatch.setattr(native_decoder, "CHUNK", part)
    for name, gradient in decoded(on_gpu, tensors, decoder)[3].items():
        assert (gradient - whole[name]).abs().max() <= 2e-6 * whole[name].abs().max(), name


REDUCED = pytest.mark.parametrize("precision", ["bfloat16", "float16"])
OF_PRODUCTS = ["opacity", "attributes", "backward"]  # kernels of csrc/cuda/networks*.cu


@contextmanager
def products_of_ours():
    """Yield the list of called kernels with products of networks."""
    called: list[str] = []

    @contextmanager
    def stage(name: str):
        if name.startswith("padgs_cuda_networks_") and name.split("_")[-1] in OF_PRODUCTS:
            called.append(name.split("_")[-1])
        yield

    with call_hook(stage):
        yield called


def assert_near(ours, truth, limit: float, of_gradients: float) -> None:
    """Compare two results of `decoded`; limits are shares of norms."""
    assert torch.equal(ours[1], truth[1]) and (ours[2] - truth[2]).abs().max() < limit
    for name, value in vars(truth[0]).items():
        assert (getattr(ours[0], name) - value).norm() <= limit * value.norm(), name
    for name, expected in truth[3].items():
        assert (ours[3][name] - expected).norm() <= of_gradients * expected.norm(), name


def unit(dtype: torch.dtype | None) -> float:
    return torch.finfo(dtype or torch.float32).eps / 2


@REDUCED
def test_reduced_precisions_match_the_definition_and_stay_near_float32(precision: str, generator: torch.Generator):
    tensors, decoder = problem(300, 10, 37, 32, generator)
    with torch.no_grad():  # opacities away from the threshold, so that rounding selects nobody else
        decoder.opacity["b2"] += 4
    with products_of_ours() as called:
        ours = decoded(on_gpu, tensors, decoder, precision)
    assert called == OF_PRODUCTS
    assert all(value.dtype == torch.float32 for value in (ours[2], *vars(ours[0]).values(), *ours[3].values()))
    u, u_of_gradients = unit(reduced_dtype(precision)), unit(GRADIENT_TYPE)
    # Sums in another order may be rounded to the number beside.
    assert_near(ours, decoded(define_gaussians, tensors, decoder, precision), 8 * u, 8 * u_of_gradients)
    flips = (4 * u) ** 0.5  # of the norm: near enough to 0, a share of some u of the hidden units changes sides
    assert_near(ours, decoded(define_gaussians, tensors, decoder), 16 * u, 8 * u_of_gradients + flips)
    exact = on_gpu(decoder.weights(), SeenAnchors(**tensors))[0]
    assert torch.equal(ours[0].means, exact.means) and not torch.equal(ours[0].colors, exact.colors)


@REDUCED
@pytest.mark.parametrize("anchors", [1, 17, 300])
@pytest.mark.parametrize(("offsets", "inputs", "hidden"), [(10, 36, 16), (1, 36, 32), (3, 37, 20)])
def test_reduced_precisions_match_the_definition_in_any_size(
    precision: str, anchors: int, offsets: int, inputs: int, hidden: int, generator: torch.Generator
):
    tensors, decoder = problem(anchors, offsets, inputs, hidden, generator)
    with torch.no_grad():  # some Gaussians of each anchor are selected, and some are not; none nearly
        decoder.opacity["w2"] *= 0.1
        decoder.opacity["b2"][:] = torch.where(torch.arange(offsets) % 3 == 1, -1.0, 1.0)
    with products_of_ours() as called:
        ours = decoded(on_gpu, tensors, decoder, precision)
    assert called == OF_PRODUCTS and len(ours[1]) == anchors * (offsets - (offsets + 1) // 3)
    truth = decoded(define_gaussians, tensors, decoder, precision)
    assert_near(ours, truth, 8 * unit(reduced_dtype(precision)), 8 * unit(GRADIENT_TYPE))
    assert all(gradient.any() for gradient in ours[3].values()) or anchors == 1


@REDUCED
@pytest.mark.parametrize(("offsets", "inputs", "hidden"), [(11, 37, 32), (10, 48, 32), (10, 37, 33)])
def test_large_networks_use_torch(precision, offsets, inputs, hidden, generator: torch.Generator):
    tensors, decoder = problem(20, offsets, inputs, hidden, generator)
    with torch.no_grad():
        decoder.opacity["b2"] += 4
    with products_of_ours() as called:
        ours = decoded(on_gpu, tensors, decoder, precision)
    assert called == []
    truth = decoded(define_gaussians, tensors, decoder, precision)
    assert_near(ours, truth, 8 * unit(reduced_dtype(precision)), 8 * unit(GRADIENT_TYPE))


@pytest.mark.slow
def test_blocks_go_on_to_further_anchors(generator: torch.Generator):
    tensors, decoder = problem(64 * 512 + 100, 1, 36, 32, generator)
    with torch.no_grad():
        decoder.opacity["b2"] += 4
    ours, truth = (decoded(function, tensors, decoder, "bfloat16") for function in (on_gpu, define_gaussians))
    assert_near(ours, truth, 8 * unit(torch.bfloat16), 8 * unit(GRADIENT_TYPE))


@REDUCED
def test_reduced_precisions_are_the_same_bits_again(precision: str, generator, monkeypatch: pytest.MonkeyPatch):
    tensors, decoder = problem(150, 10, 37, 32, generator)
    first = decoded(on_gpu, tensors, decoder, precision)
    for seed in range(2):
        monkeypatch.setenv("PADGS_EMULATION_SEED", str(seed))  # another order, where the GPU is emulated
        again = decoded(on_gpu, tensors, decoder, precision)
        assert torch.equal(again[1], first[1]) and torch.equal(again[2], first[2])
        for ours, before in ((vars(again[0]), vars(first[0])), (again[3], first[3])):
            assert all(torch.equal(ours[name], value) for name, value in before.items())


@pytest.mark.parametrize("hidden", [32, 20])
@pytest.mark.parametrize("large", ["features", "w1", "w2"])
def test_float16_overflows_where_the_definition_does(large: str, hidden: int, generator: torch.Generator):
    tensors, decoder = problem(40, 10, 37, hidden, generator)
    with torch.no_grad():
        decoder.opacity["b2"] += 4
        if large == "features":
            tensors["features"][7, 3] = 1e5
        else:
            decoder.color[large][2] *= 3e5
    ours, truth = (
        function(decoder.weights(), SeenAnchors(**tensors), "float16") for function in (on_gpu, define_gaussians)
    )
    said, colors = ours[2], ours[0].colors
    overflown = torch.cat((said.isnan().flatten(), ~((colors > 0) & (colors < 1)).flatten()))  # sigmoids at their ends
    assert overflown.any() and not overflown.all() and torch.equal(ours[1], truth[1])
    for value, expected in zip((ours[2], *vars(ours[0]).values()), (truth[2], *vars(truth[0]).values()), strict=True):
        torch.testing.assert_close(value, expected, atol=4e-3, rtol=4e-3, equal_nan=True)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("rows", ["all", "some more", "too few"])
def test_decoding_with_capacity_pads_with_zeros(precision: str, rows: str, generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)
    exact, slots, raw = on_gpu(decoder.weights(), SeenAnchors(**tensors), precision)
    count = len(exact)
    assert 100 < count < 500
    room = {"all": 1000, "some more": count + 30, "too few": count - 30}[rows]
    within, all_slots, same_raw, said = decode_with_capacity(decoder.weights(), SeenAnchors(**tensors), room, precision)
    assert said.tolist() == [count] and len(within) == len(all_slots) == min(room, 600) and torch.equal(raw, same_raw)
    for name, value in vars(exact).items():
        found = getattr(within, name)
        assert torch.equal(found[:count], value[:room]) and not found[count:].any(), name
    assert torch.equal(all_slots[:count], slots[:room])
    others = (raw <= 0).flatten().nonzero()[:, 0]
    assert torch.equal(all_slots[count:], others[: len(all_slots[count:])])


@pytest.mark.parametrize("precision", PRECISIONS)
def test_gaussians_beyond_capacity_have_no_gradient(precision: str, generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)
    count = len(on_gpu(decoder.weights(), SeenAnchors(**tensors), precision)[0])
    upstream, found = torch.randn(count - 30, 3, generator=generator), []
    leaves = [tensors[name].requires_grad_() for name in ("features", "offsets", "log_scales")]
    for room in (count - 30, count):
        gaussians = decode_with_capacity(decoder.weights(), SeenAnchors(**tensors), room, precision)[0]
        loss = sum((getattr(gaussians, of)[: count - 30] * upstream).sum() for of in ("means", "scales", "colors"))
        found.append(torch.autograd.grad(loss, [*leaves, *decoder.parameters()], allow_unused=True))
    for less, all_of_them in zip(*found, strict=True):
        assert less is None or torch.equal(less, all_of_them)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda tensors: tensors | {"seen": tensors["seen"][:, :-1]}, "networks of 37 inputs do not fit"),
        (lambda tensors: tensors | {"offsets": tensors["offsets"].double()}, "must be float32"),
    ],
)
def test_fused_kernels_refuse_unsupported_inputs(change, said, generator: torch.Generator):
    tensors, decoder = problem(10, 10, 37, 32, generator)
    with pytest.raises(ValueError, match=said):
        on_gpu(decoder.weights(), SeenAnchors(**change(tensors)), "bfloat16")


@pytest.mark.parametrize("precision", PRECISIONS)
def test_rows_behind_the_selected_change_no_gradient(precision: str, generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)

    def within(weights: DecoderWeights, anchors: SeenAnchors, precision: str):
        gaussians, slots, raw, count = decode_with_capacity(weights, anchors, 600, precision)
        return gaussians.first(int(count)), slots, raw

    exact, padded = (decoded(function, tensors, decoder, precision)[3] for function in (on_gpu, within))
    assert all(torch.equal(padded[name], gradient) for name, gradient in exact.items())


def test_decoding_with_capacity_requires_the_gpu_library(generator: torch.Generator):
    tensors, decoder = problem(3, 10, 37, 32, generator)
    with pytest.raises(ValueError, match="decoding with a capacity takes float32 on a GPU; got torch.float64 on "):
        decode_with_capacity(decoder.weights(), SeenAnchors(*(tensor.double() for tensor in tensors.values())), 30)


def test_nothing_selected(generator: torch.Generator):
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
