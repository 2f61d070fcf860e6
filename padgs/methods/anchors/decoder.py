"""The decoder: three small networks that turn an anchor as seen from a camera into K Gaussians (paper Eq. 13-14).

`decode_gaussians` is a pure function of tensors. It calls a native library if there is one, for float32;
`define_gaussians` is the definition.
"""

import math
from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn

from padgs.gaussians import Gaussians
from padgs.methods.anchors import native_decoder
from padgs.methods.anchors.native_decoder import COLOR_VALUES, COVARIANCE_VALUES, OPACITY_VALUES
from padgs.native import cpu, library_for


class Head(NamedTuple):
    """A network w2 relu(w1 x + b1) + b2."""

    w1: Tensor  # [H, I]
    b1: Tensor  # [H]
    w2: Tensor  # [O, H]
    b2: Tensor  # [O]

    def __call__(self, inputs: Tensor) -> Tensor:
        """Return outputs [A, O] for inputs [A, I]."""
        hidden = torch.relu(torch.addmm(self.b1, inputs, self.w1.T))
        return torch.addmm(self.b2, hidden, self.w2.T)


class DecoderWeights(NamedTuple):
    """The three networks; all take the same inputs, O = K, 3 K and 7 K."""

    opacity: Head
    color: Head
    covariance: Head


class SeenAnchors(NamedTuple):
    """A anchors as a camera sees them; differentiable by features, offsets and log-scales."""

    features: Tensor  # [A, C]
    seen: Tensor  # [A, I - C] direction from the camera; distance and distortion if they are inputs
    positions: Tensor  # [A, 3] world axes
    offsets: Tensor  # [A, K, 3] in units of the anchor's scale
    log_scales: Tensor  # [A, 6]; the first three scale the offsets, the last three the Gaussians
    attenuation: Tensor  # [A] factor on opacities (Eq. 15)


def decode_gaussians(
    weights: DecoderWeights, anchors: SeenAnchors, capacity: int | None = None
) -> tuple[Gaussians, Tensor, Tensor, Tensor | None]:
    """Return the N selected Gaussians in the order of their slots, slots, raw opacities, and N [1] or None (Eq. 13-15).

    Slots [N] int64 are anchor K + k, raw opacities [A, K] have no gradient; else it is differentiable by weights,
    features, offsets and log-scales. `capacity`: on a GPU with the library, a number of rows, so that the host need not
    wait for N, which is returned: the selected Gaussians up to it, then zeros, which are culled.
    """
    library = library_for(anchors.features)
    if library is None:
        return *define_gaussians(weights, anchors), None
    flat = tuple(tensor for head in weights for tensor in head)
    if library is cpu:
        *values, slots, raw = native_decoder.decode_on_cpu(*anchors, *flat)
        return Gaussians(*values), slots, raw, None
    capacity = None if capacity is None else min(capacity, anchors.offsets[..., 0].numel())
    *values, slots, raw, count = native_decoder.decode_on_gpu(capacity, *anchors, *flat)
    return Gaussians(*values), slots, raw, None if capacity is None else count


def define_gaussians(weights: DecoderWeights, anchors: SeenAnchors) -> tuple[Gaussians, Tensor, Tensor]:
    """Compute `decode_gaussians` in torch, for any dtype and device."""
    inputs = torch.cat((anchors.features, anchors.seen), dim=-1)
    raw_opacities = torch.tanh(weights.opacity(inputs))  # [A, K]
    slots = (raw_opacities.detach() > 0).view(-1).nonzero()[:, 0]
    rows = slots // anchors.offsets.shape[1]
    colors = take_rows(weights.color(inputs).view(-1, COLOR_VALUES), slots)
    covariances = weights.covariance(inputs).view(-1, COVARIANCE_VALUES)
    shrinkage, quats = take_rows(covariances, slots).split((3, 4), dim=-1)
    reach, size = take_rows(torch.exp(anchors.log_scales), rows).split((3, 3), dim=-1)
    gaussians = Gaussians(
        means=take_rows(anchors.positions, rows) + reach * take_rows(anchors.offsets.view(-1, 3), slots),
        quats=quats,
        scales=size * torch.sigmoid(shrinkage),
        opacities=take_rows(raw_opacities.view(-1, 1), slots)[:, 0] * anchors.attenuation[rows],
        colors=torch.sigmoid(colors),
    )
    return gaussians, slots, raw_opacities.detach()


def take_rows(table: Tensor, rows: Tensor) -> Tensor:
    """Return rows [N, D] of a table [R, D] by gather, whose backward is several times faster on CPUs than indexing."""
    return table.gather(0, rows[:, None].expand(-1, table.shape[1]))


class Decoder(nn.Module):
    """Weights of the three networks, initialised as torch.nn.Linear."""

    def __init__(self, inputs: int, offsets: int, hidden: int = 32, *, generator: Generator | None = None) -> None:
        """Build networks from `inputs` values per anchor to `offsets` Gaussians, with one hidden layer."""
        super().__init__()
        values = (OPACITY_VALUES, COLOR_VALUES, COVARIANCE_VALUES)
        self.opacity, self.color, self.covariance = (_layers(inputs, hidden, n * offsets, generator) for n in values)

    def weights(self) -> DecoderWeights:
        """Return the weights as `decode` takes them."""
        return DecoderWeights(Head(**self.opacity), Head(**self.color), Head(**self.covariance))


def _layers(inputs: int, hidden: int, outputs: int, generator: torch.Generator | None) -> nn.ParameterDict:
    shapes = {"w1": (hidden, inputs), "b1": (hidden,), "w2": (outputs, hidden), "b2": (outputs,)}
    layers = nn.ParameterDict()
    for name, shape in shapes.items():
        bound = 1 / math.sqrt(inputs if name.endswith("1") else hidden)
        layers[name] = nn.Parameter(torch.empty(shape).uniform_(-bound, bound, generator=generator))
    return layers
