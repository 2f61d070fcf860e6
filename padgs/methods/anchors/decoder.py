"""The decoder: three small networks that turn an anchor as seen from a camera into K Gaussians (paper Eq. 13-14).

`decode_gaussians` is a pure function of tensors. Where a native library can do it (float32 on the CPU, any precision on
a GPU) that is called; `define_gaussians` is the definition that it has to match. Precision is a matter of the networks'
products alone: what becomes of their outputs is computed in the tensors' own type.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor, nn

from padgs.gaussians import Gaussians
from padgs.methods.anchors.cpu_decoder import COLOR_VALUES, COVARIANCE_VALUES, OPACITY_VALUES, decode_on_cpu
from padgs.methods.anchors.gpu_decoder import decode_on_gpu
from padgs.methods.anchors.precision import linear, reduced
from padgs.native import LIBRARIES, cpu, cuda

SORT_OUT_BELOW = 0.9  # share of anchors with a positive opacity


class Head(NamedTuple):
    """A network w2 relu(w1 x + b1) + b2."""

    w1: Tensor  # [H, I]
    b1: Tensor  # [H]
    w2: Tensor  # [O, H]
    b2: Tensor  # [O]

    def __call__(self, inputs: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """Outputs [A, O] for inputs [A, I]; products in a reduced type, see `padgs.methods.anchors.precision`."""
        hidden = torch.relu(linear(inputs, self.w1, self.b1, dtype))
        return linear(hidden, self.w2, self.b2, dtype)


class DecoderWeights(NamedTuple):
    """The three networks; all take the same inputs, O = K, 3 K and 7 K."""

    opacity: Head
    color: Head
    covariance: Head


class SeenAnchors(NamedTuple):
    """A anchors as a camera sees them; differentiable by features, offsets and log-scales."""

    features: Tensor  # [A, C]
    seen: Tensor  # [A, I - C] direction from the camera, and distance and distortion if they are inputs
    positions: Tensor  # [A, 3] world
    offsets: Tensor  # [A, K, 3] in units of the anchor's scale
    log_scales: Tensor  # [A, 6]; the first three scale the offsets, the last three the Gaussians
    attenuation: Tensor  # [A], what Eq. 15 multiplies opacities by


class Attributes(NamedTuple):
    """What the networks say, for the N selected of the A K Gaussians, in the order of their slots."""

    raw_opacities: Tensor  # [A, K] in (-1, 1), all of them; a Gaussian is selected where this is positive
    slots: Tensor  # [N] int64 ascending, anchor K + k
    opacities: Tensor  # [N] in (0, 1), before modulation
    colors: Tensor  # [N, 3] in (0, 1)
    shrinkage: Tensor  # [N, 3] in (0, 1), share of the anchor's scale
    quats: Tensor  # [N, 4] wxyz, not normalised


def decode(weights: DecoderWeights, inputs: Tensor, dtype: torch.dtype | None = None) -> Attributes:
    """Decode anchors (Eq. 13): opacity by tanh, colour and shrinkage by sigmoid.

    Opacity comes first; the other two networks, nine tenths of the work, see only anchors with a positive one. The
    values of the others are never used, so the result is exact. Where few anchors are dead, sorting them out costs more
    than it saves, and all are decoded.

    Args:
        weights: the three networks.
        inputs: [A, I], one row per anchor.
        dtype: what the networks' products are taken in, see `padgs.methods.anchors.precision`.
    """
    raw_opacities = torch.tanh(weights.opacity(inputs, dtype))  # [A, K]
    count, offsets = raw_opacities.shape
    selected = raw_opacities.detach() > 0
    alive = selected.any(-1).nonzero()[:, 0]  # [B]
    slots = selected.view(-1).nonzero()[:, 0]
    if len(alive) < SORT_OUT_BELOW * count:
        inputs = take_rows(inputs, alive)
        decoded_slots = selected[alive].view(-1).nonzero()[:, 0]  # [N] rows among the B K decoded Gaussians
    else:
        decoded_slots = slots
    colors = weights.color(inputs, dtype).view(-1, COLOR_VALUES)
    covariances = weights.covariance(inputs, dtype).view(-1, COVARIANCE_VALUES)
    shrinkage, quats = take_rows(covariances, decoded_slots).split((3, 4), dim=-1)
    return Attributes(
        raw_opacities,
        slots,
        take_rows(raw_opacities.view(-1, 1), slots)[:, 0],
        torch.sigmoid(take_rows(colors, decoded_slots)),
        torch.sigmoid(shrinkage),
        quats,
    )


def decode_gaussians(
    weights: DecoderWeights, anchors: SeenAnchors, precision: str = "float32"
) -> tuple[Gaussians, Tensor, Tensor]:
    """The selected Gaussians of all anchors (Eq. 13-15); differentiable by weights, features, offsets and log-scales.

    Args:
        weights: the three networks, of I inputs.
        anchors: what is decoded.
        precision: of the networks' products, a name of `padgs.methods.anchors.precision.PRECISIONS`. Others than float32 are
            made for GPUs; on the CPU they are slower.

    Returns:
        N Gaussians in the order of their slots; slots [N] int64, anchor K + k; raw opacities [A, K] without gradient.

    Raises:
        ValueError: an unknown precision.
    """
    library = _library_for(anchors, precision)
    if library is None:
        return define_gaussians(weights, anchors, precision)
    flat = tuple(tensor for head in weights for tensor in head)
    if library is cuda:
        *values, slots, raw, _ = decode_on_gpu(flat, *anchors, dtype=reduced(precision))
    else:
        *values, slots, raw = decode_on_cpu(flat, *anchors)
    return Gaussians(*values), slots, raw


def decodes_within(anchors: SeenAnchors, precision: str = "float32") -> bool:
    """Whether `decode_within` takes these tensors: float32 on a GPU that the library works on."""
    return _library_for(anchors, precision) is cuda


def decode_within(
    weights: DecoderWeights, anchors: SeenAnchors, room: int, precision: str = "float32"
) -> tuple[Gaussians, Tensor, Tensor, Tensor]:
    """`decode_gaussians` without the host waiting for how many are selected.

    Args:
        weights, anchors, precision: as there.
        room: there are so many Gaussians, or all A K if those are fewer: first the selected ones, as far as there is
            room, behind them zeros, which nobody draws.

    Returns:
        What is returned there, the slots of the zeros being those of others that are not selected; N, [1] int64.

    Raises:
        ValueError: tensors that are not float32 on a GPU, or an unknown precision.
        OSError: the GPU's library was not built.
    """
    features = anchors.features
    if features.dtype != torch.float32 or features.device.type != cuda.device_type():
        raise ValueError(
            f"only a GPU decodes without counting, and float32; got {features.dtype} on {features.device}. Convert "
            "them, or use decode_gaussians"
        )
    flat = tuple(tensor for head in weights for tensor in head)
    room = min(room, anchors.offsets[..., 0].numel())
    *values, slots, raw, count = decode_on_gpu(flat, *anchors, dtype=reduced(precision), room=room)
    return Gaussians(*values), slots, raw, count


def _library_for(anchors: SeenAnchors, precision: str) -> ModuleType | None:
    """What decodes these tensors; None: torch does."""
    dtype, library = reduced(precision), LIBRARIES.get(anchors.features.device.type)
    no_reduced_types = dtype is not None and library is cpu
    if library is None or no_reduced_types or anchors.features.dtype != torch.float32:
        return None
    return library if library.works_on(anchors.features.device) else None


def define_gaussians(
    weights: DecoderWeights, anchors: SeenAnchors, precision: str = "float32"
) -> tuple[Gaussians, Tensor, Tensor]:
    """`decode_gaussians` in torch, for any dtype, precision and device."""
    said = decode(weights, torch.cat((anchors.features, anchors.seen), dim=-1), reduced(precision))
    rows = said.slots // anchors.offsets.shape[1]
    reach, size = take_rows(torch.exp(anchors.log_scales), rows).split((3, 3), dim=-1)
    gaussians = Gaussians(
        means=take_rows(anchors.positions, rows) + reach * take_rows(anchors.offsets.view(-1, 3), said.slots),
        quats=said.quats,
        scales=size * said.shrinkage,
        opacities=said.opacities * anchors.attenuation[rows],
        colors=said.colors,
    )
    return gaussians, said.slots, said.raw_opacities.detach()


def take_rows(table: Tensor, rows: Tensor) -> Tensor:
    """Rows [N, D] of a table [R, D]; a gather, because on CPUs its backward is several times faster than indexing's."""
    return table.gather(0, rows[:, None].expand(-1, table.shape[1]))


class Decoder(nn.Module):
    """Owns the weights of the three networks, initialised as torch.nn.Linear does."""

    def __init__(
        self, inputs: int, offsets: int, hidden: int = 32, *, generator: torch.Generator | None = None
    ) -> None:
        """Networks from `inputs` values per anchor to `offsets` Gaussians, with one hidden layer of `hidden` units."""
        super().__init__()
        self.opacity = _layers(inputs, hidden, OPACITY_VALUES * offsets, generator)
        self.color = _layers(inputs, hidden, COLOR_VALUES * offsets, generator)
        self.covariance = _layers(inputs, hidden, COVARIANCE_VALUES * offsets, generator)

    def weights(self) -> DecoderWeights:
        """The weights as `decode` takes them."""
        return DecoderWeights(Head(**self.opacity), Head(**self.color), Head(**self.covariance))


def _layers(inputs: int, hidden: int, outputs: int, generator: torch.Generator | None) -> nn.ParameterDict:
    shapes = {"w1": (hidden, inputs), "b1": (hidden,), "w2": (outputs, hidden), "b2": (outputs,)}
    layers = nn.ParameterDict()
    for name, shape in shapes.items():
        bound = 1 / math.sqrt(inputs if name.endswith("1") else hidden)
        layers[name] = nn.Parameter(torch.empty(shape).uniform_(-bound, bound, generator=generator))
    return layers
