"""Rays of training pixels, and samples along rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.geometry.camera import Camera
from padgs.scene import View
from padgs.training.model import State
from padgs.training.targets import image_of, weight_of

MIN_WEIGHT = 1e-5  # added to every weight, so that empty rays are still sampled everywhere


@dataclass(frozen=True)
class Rays:
    """B rays and their ground truth."""

    origins: Tensor  # [B, 3] float64 world
    directions: Tensor  # [B, 3] unit, world
    color: Tensor  # [B, 3] in [0, 1]
    weight: Tensor  # [B] > 0


class RayPixels:
    """All unmasked pixels of some views; 7 bytes per pixel, 11 if weights differ.

    Attributes:
        generator: all random choices of an iteration.
    """

    def __init__(
        self, views: Sequence[View], weight: str = "uniform", device: torch.device | str = "cpu", seed: int = 0
    ) -> None:
        """Load every view once; `weight` is a name of `padgs.training.loss.ROW_WEIGHTS`."""
        colors, places, weights = [], [], []
        tables: dict[Camera, tuple[int, Tensor]] = {}  # start among all directions, directions
        starts, total = [], 0
        for view in views:
            image, of_pixel = image_of(view, device), weight_of(view, weight, device)
            of_pixel = of_pixel.expand(view.height, view.width).reshape(-1)
            kept = of_pixel.nonzero().squeeze(-1)
            colors.append((image.reshape(-1, 3)[kept] * 255).round().to(torch.uint8))
            places.append(kept.to(torch.int32))
            weights.append(of_pixel[kept])
            if view.camera not in tables:
                tables[view.camera] = total, view.camera.rays(device=device).reshape(-1, 3)
                total += view.width * view.height
            starts.append(tables[view.camera][0])
        self._colors, self._places = torch.cat(colors), torch.cat(places)
        self._weights = None if all((w == 1).all() for w in weights) else torch.cat(weights)
        self._directions = torch.cat([table for _, table in tables.values()])
        self._starts = torch.tensor(starts, device=device)
        self._ends = torch.tensor([len(place) for place in places], device=device).cumsum(0)
        self._centers = torch.stack([view.center.double() for view in views]).to(device)
        self.generator = torch.Generator().manual_seed(seed)
        self._rotations = torch.stack([view.cam_from_world[:3, :3] for view in views]).to(self._directions)

    def __len__(self) -> int:
        return len(self._colors)

    def draw(self, count: int) -> Rays:
        """Return `count` rays through the centres of random pixels, uniformly, with replacement."""
        return self.at(torch.randint(len(self), (count,), generator=self.generator).to(self._colors.device))

    def at(self, indices: Tensor) -> Rays:
        """Return the rays through pixels [B], counted view by view and row by row."""
        view = torch.searchsorted(self._ends, indices, right=True)
        in_camera = self._directions[self._starts[view] + self._places[indices]]
        directions = torch.einsum("bc,bcw->bw", in_camera, self._rotations[view])
        weight = torch.ones_like(directions[:, 0]) if self._weights is None else self._weights[indices]
        return Rays(self._centers[view], directions, self._colors[indices].to(directions) / 255, weight)

    def state(self) -> State:
        """Return the random state."""
        return State({"random/rays": self.generator.get_state()}, {"pixels": len(self)})

    def load(self, state: State) -> None:
        """Restore it from the state of a trainer."""
        if state.values["pixels"] != len(self):
            raise ValueError(
                f"the state is of a run on {state.values['pixels']} pixels, but the training views have {len(self)}; "
                "resume with the data it was trained on"
            )
        self.generator.set_state(state.tensors["random/rays"].cpu())


def jittered(distances: Tensor, random: Tensor) -> Tensor:
    """Return distances [..., S], each moved by a share `random` [..., S] in [0, 1) of the interval behind it."""
    return distances + interval_lengths(distances) * random


def interval_lengths(distances: Tensor) -> Tensor:
    """Return the length [..., S] of the interval behind each distance [..., S]; the last repeats the one before.

    >>> interval_lengths(torch.tensor([1.0, 2.0, 5.0])).tolist()
    [1.0, 3.0, 3.0]
    """
    lengths = distances.diff(dim=-1)
    return torch.cat((lengths, lengths[..., -1:]), dim=-1)


def refined(distances: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """Return distances of fine samples [B, F]: quantiles of the weights of the coarse samples.

    Args:
        distances: [B, S] increasing.
        weights: [B, S] >= 0; weight k lies between the midpoints around distance k, the outer two are ignored.
        shares: [B, F] in [0, 1], of the total weight.
    """
    midpoints = (distances[:, 1:] + distances[:, :-1]) / 2
    return inverse_cdf(midpoints, weights[:, 1:-1] + MIN_WEIGHT, shares)


def inverse_cdf(edges: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """Return quantiles [B, F] of a piecewise constant density.

    Args:
        edges: [B, M + 1] increasing, of the pieces.
        weights: [B, M] > 0, mass of each piece up to a factor.
        shares: [B, F] in [0, 1], of the mass below each quantile.

    >>> inverse_cdf(torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([[1.0, 3.0]]), torch.tensor([[0.25, 0.625]])).tolist()
    [[1.0, 1.5]]
    """
    cumulative = torch.cat((torch.zeros_like(weights[:, :1]), weights.cumsum(-1)), dim=-1)
    mass = (shares * cumulative[:, -1:]).contiguous()
    piece = torch.searchsorted(cumulative, mass, right=True).clamp(1, weights.shape[1]) - 1
    below, weight = cumulative.gather(1, piece), weights.gather(1, piece)
    low, high = edges.gather(1, piece), edges.gather(1, piece + 1)
    return low + (high - low) * ((mass - below) / weight).clamp(0, 1)


def visible_shares(optical_depths: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weight of each interval of a ray, and the transmittance behind all; together 1.

    weight_k = exp(-sum of the depths in front) (1 - exp(-depth_k)), exact for intervals of constant density.

    Args:
        optical_depths: [..., S] >= 0, density times length of the intervals, from front to back.

    Returns:
        weights [..., S], residual [...].

    >>> weights, residual = visible_shares(torch.tensor([0.6931472, 0.6931472]))
    >>> weights.tolist(), residual.item()
    ([0.5, 0.25], 0.25)
    """
    behind = torch.exp(-optical_depths.cumsum(-1))
    front = torch.cat((torch.ones_like(behind[..., :1]), behind[..., :-1]), dim=-1)
    return front * -torch.expm1(-optical_depths), behind[..., -1]
