"""Decoding on the GPU against its definition: values and gradients; on the GPU or emulated."""

import functools

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
)
from padgs.methods.anchors.native_decoder import decode_on_gpu

pytestmark = [*cuda_engine.marks()]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"
problem = functools.partial(decoder_cases.problem, device=DEVICE)


def on_gpu(
    weights: DecoderWeights, anchors: SeenAnchors, capacity: int | None = None
) -> tuple[Gaussians, Tensor, Tensor, Tensor | None]:
    """Decode as `decode_gaussians` does for tensors of a GPU."""
    if cuda_engine.ON_GPU:
        return decode_gaussians(weights, anchors, capacity)
    flat, rows = tuple(tensor for head in weights for tensor in head), anchors.offsets[..., 0].numel()
    capacity = None if capacity is None else min(capacity, rows)
    *values, slots, raw, count = decode_on_gpu(capacity, *anchors, *flat)
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


@pytest.mark.parametrize("rows", ["all", "some more", "too few"])
def test_decoding_with_capacity_pads_with_zeros(rows: str, generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)
    exact, slots, raw, _ = on_gpu(decoder.weights(), SeenAnchors(**tensors))
    count = len(exact)
    assert 100 < count < 500
    capacity = {"all": 1000, "some more": count + 30, "too few": count - 30}[rows]
    within, all_slots, same_raw, said = on_gpu(decoder.weights(), SeenAnchors(**tensors), capacity)
    assert said.tolist() == [count] and len(within) == len(all_slots) == min(capacity, 600)
    for name, value in vars(exact).items():
        found = getattr(within, name)
        assert torch.equal(found[:count], value[:capacity]) and not found[count:].any(), name
    assert torch.equal(all_slots[:count], slots[:capacity])
    others = (raw <= 0).flatten().nonzero()[:, 0]
    assert torch.equal(all_slots[count:], others[: len(all_slots[count:])])


def test_gaussians_beyond_capacity_have_no_gradient(generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)
    count = len(on_gpu(decoder.weights(), SeenAnchors(**tensors))[0])
    upstream, found = torch.randn(count - 30, 3, generator=generator).to(DEVICE), []
    leaves = [tensors[name].requires_grad_() for name in LEARNED]
    for capacity in (count - 30, count):
        gaussians = on_gpu(decoder.weights(), SeenAnchors(**tensors), capacity)[0]
        loss = sum((getattr(gaussians, of)[: count - 30] * upstream).sum() for of in ("means", "scales", "colors"))
        found.append(torch.autograd.grad(loss, [*leaves, *decoder.parameters()], allow_unused=True))
    for less, all_of_them in zip(*found, strict=True):
        assert less is None or torch.equal(less, all_of_them)


def test_rows_behind_the_selected_change_no_gradient(generator: torch.Generator):
    tensors, decoder = problem(60, 10, 37, 32, generator)

    def within(weights: DecoderWeights, anchors: SeenAnchors):
        gaussians, slots, raw, count = on_gpu(weights, anchors, 600)
        return gaussians.chosen(slice(int(count))), slots, raw

    exact, padded = (decoded(function, tensors, decoder)[3] for function in (on_gpu, within))
    assert all(torch.equal(padded[name], gradient) for name, gradient in exact.items())
