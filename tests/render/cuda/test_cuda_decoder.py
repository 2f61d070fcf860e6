"""Decoding on the GPU against its definition: values and gradients; on the GPU or emulated."""

import functools
from contextlib import contextmanager

import pytest
import torch
from support import cuda_engine, decoder_cases
from support.decoder_cases import EVERY_SIZE, LEARNED, assert_matches_definition, decoded
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.anchors import native_decoder
from padgs.methods.anchors.decoder import (
    DecoderWeights,
    SeenAnchors,
    decode_gaussians,
    define_gaussians,
)
from padgs.methods.anchors.native_decoder import GRADIENT_TYPE, PRECISIONS, decode_on_gpu, reduced_dtype
from padgs.native.loading import call_hook

pytestmark = [*cuda_engine.marks()]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"
problem = functools.partial(decoder_cases.problem, device=DEVICE)


def on_gpu(
    weights: DecoderWeights, anchors: SeenAnchors, precision: str = "float32", capacity: int | None = None
) -> tuple[Gaussians, Tensor, Tensor, Tensor | None]:
    """Decode as `decode_gaussians` does for tensors of a GPU."""
    if cuda_engine.ON_GPU:
        return decode_gaussians(weights, anchors, precision, capacity)
    flat, rows = tuple(tensor for head in weights for tensor in head), anchors.offsets[..., 0].numel()
    capacity = None if capacity is None else min(capacity, rows)
    *values, slots, raw, count = decode_on_gpu(flat, *anchors, dtype=reduced_dtype(precision), capacity=capacity)
    return Gaussians(*values), slots, raw, count


@pytest.mark.parametrize("anchors", [1, 17, 300])
@pytest.mark.parametrize(("offsets", "inputs", "hidden"), EVERY_SIZE)
def test_the_gpu_matches_the_definition(anchors: int, offsets: int, inputs: int, hidden: int, generator):
    assert_matches_definition(on_gpu, *problem(anchors, offsets, inputs, hidden, generator))


@pytest.mark.parametrize("part", [100, 128])
def test_products_in_parts_sum_up_to_the_whole(part: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch):
    tensors, decoder = problem(300, 10, 37, 32, generator)
    whole = decoded(on_gpu, tensors, decoder)[3]
    monkeypatch.setattr(native_decoder, "CHUNK", part)
    for name, gradient in decoded(on_gpu, tensors, decoder)[3].items():
        assert (gradient - whole[name]).abs().max() <= 2e-6 * whole[name].abs().max(), name


REDUCED = pytest.mark.parametrize("precision", ["bfloat16", "float16"])
PRODUCT_KERNELS = ["opacity", "attributes", "backward"]  # kernels of csrc/cuda/networks*.cu


@contextmanager
def called_product_kernels():
    """Yield the list of called kernels with products of networks."""
    called: list[str] = []

    @contextmanager
    def stage(name: str):
        if name.startswith("padgs_cuda_networks_") and name.split("_")[-1] in PRODUCT_KERNELS:
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
    # Opacities away from the threshold, so that rounding selects the same Gaussians.
    tensors, decoder = problem(300, 10, 37, 32, generator, bias=4)
    with called_product_kernels() as called:
        ours = decoded(on_gpu, tensors, decoder, precision)
    assert called == PRODUCT_KERNELS
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
    with called_product_kernels() as called:
        ours = decoded(on_gpu, tensors, decoder, precision)
    assert called == PRODUCT_KERNELS and len(ours[1]) == anchors * (offsets - (offsets + 1) // 3)
    truth = decoded(define_gaussians, tensors, decoder, precision)
    assert_near(ours, truth, 8 * unit(reduced_dtype(precision)), 8 * unit(GRADIENT_TYPE))
    assert all(gradient.any() for gradient in ours[3].values()) or anchors == 1


@REDUCED
@pytest.mark.parametrize(("offsets", "inputs", "hidden"), [(11, 37, 32), (10, 48, 32), (10, 37, 33)])
def test_large_networks_use_torch(precision, offsets, inputs, hidden, generator: torch.Generator):
    tensors, decoder = problem(20, offsets, inputs, hidden, generator, bias=4)
    with called_product_kernels() as called:
        ours = decoded(on_gpu, tensors, decoder, precision)
    assert called == []
    truth = decoded(define_gaussians, tensors, decoder, precision)
    assert_near(ours, truth, 8 * unit(reduced_dtype(precision)), 8 * unit(GRADIENT_TYPE))


@pytest.mark.slow
def test_blocks_go_on_to_further_anchors(generator: torch.Generator):
    tensors, decoder = problem(64 * 512 + 100, 1, 36, 32, generator, bias=4)
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
    tensors, decoder = problem(40, 10, 37, hidden, generator, bias=4)
    with torch.no_grad():
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


EVERY_PRECISION = pytest.mark.parametrize("precision", PRECISIONS)


@EVERY_PRECISION
@pytest.mark.parametrize("rows", ["all", "some more", "too few"])
def test_decoding_with_capacity_pads_with_zeros(precision: str, rows: str, generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)
    exact, slots, raw, _ = on_gpu(decoder.weights(), SeenAnchors(**tensors), precision)
    count = len(exact)
    assert 100 < count < 500
    capacity = {"all": 1000, "some more": count + 30, "too few": count - 30}[rows]
    within, all_slots, same_raw, said = on_gpu(decoder.weights(), SeenAnchors(**tensors), precision, capacity)
    assert said.tolist() == [count] and len(within) == len(all_slots) == min(capacity, 600)
    for name, value in vars(exact).items():
        found = getattr(within, name)
        assert torch.equal(found[:count], value[:capacity]) and not found[count:].any(), name
    assert torch.equal(all_slots[:count], slots[:capacity])
    others = (raw <= 0).flatten().nonzero()[:, 0]
    assert torch.equal(all_slots[count:], others[: len(all_slots[count:])])


@EVERY_PRECISION
def test_gaussians_beyond_capacity_have_no_gradient(precision: str, generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)
    count = len(on_gpu(decoder.weights(), SeenAnchors(**tensors), precision)[0])
    upstream, found = torch.randn(count - 30, 3, generator=generator), []
    leaves = [tensors[name].requires_grad_() for name in LEARNED]
    for capacity in (count - 30, count):
        gaussians = on_gpu(decoder.weights(), SeenAnchors(**tensors), precision, capacity)[0]
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


@EVERY_PRECISION
def test_rows_behind_the_selected_change_no_gradient(precision: str, generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)

    def within(weights: DecoderWeights, anchors: SeenAnchors, precision: str):
        gaussians, slots, raw, count = on_gpu(weights, anchors, precision, 600)
        return gaussians.first(int(count)), slots, raw

    exact, padded = (decoded(function, tensors, decoder, precision)[3] for function in (on_gpu, within))
    assert all(torch.equal(padded[name], gradient) for name, gradient in exact.items())
