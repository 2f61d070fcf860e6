"""All training pixels in one place, to draw rays from regardless of the image they belong to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.geometry.camera import Camera
from padgs.scene import View
from padgs.training.model import State
from padgs.training.targets import image_of, weight_of


@dataclass(frozen=True)
class Rays:
    """B rays in the world and what they must show."""

    origins: Tensor  # [B, 3] float64 world
    directions: Tensor  # [B, 3] unit, world
    color: Tensor  # [B, 3] in [0, 1]
    weight: Tensor  # [B] > 0


class RayPixels:
    """The pixels of some views that their masks let through; 7 bytes for each, 11 where their weights differ.

    Attributes:
        generator: decides which are drawn, and what else is random about an iteration.
    """

    def __init__(
        self, views: Sequence[View], weight: str = "uniform", device: torch.device | str = "cpu", seed: int = 0
    ) -> None:
        """Load every view once; `weight` is a name of `padgs.training.loss.ROW_WEIGHTS`.

        Raises:
            ValueError: a view has no pixels, or they have another size than the view, or its mask leaves none.
        """
        colors, places, weights = [], [], []
        tables: dict[Camera, tuple[int, Tensor]] = {}  # where each camera's directions start among all, and they
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
        """`count` rays through the centres of random pixels, each equally likely, with replacement."""
        return self.at(torch.randint(len(self), (count,), generator=self.generator).to(self._colors.device))

    def at(self, indices: Tensor) -> Rays:
        """The rays through pixels [B], counted view by view and row by row."""
        view = torch.searchsorted(self._ends, indices, right=True)
        in_camera = self._directions[self._starts[view] + self._places[indices]]
        directions = torch.einsum("bc,bcw->bw", in_camera, self._rotations[view])
        weight = torch.ones_like(directions[:, 0]) if self._weights is None else self._weights[indices]
        return Rays(self._centers[view], directions, self._colors[indices].to(directions) / 255, weight)

    def state(self) -> State:
        """What decides the rays to come."""
        return State({"random/rays": self.generator.get_state()}, {"pixels": len(self)})

    def load(self, state: State) -> None:
        """Take that back out of a whole state.

        Raises:
            ValueError: it is of a run on other pixels.
        """
        if state.values["pixels"] != len(self):
            raise ValueError(
                f"the state is of a run on {state.values['pixels']} pixels, but the training views have {len(self)}; "
                "resume with the data it was trained on"
            )
        self.generator.set_state(state.tensors["random/rays"].cpu())
