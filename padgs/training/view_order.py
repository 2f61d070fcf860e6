"""The order of training views: random, without replacement until all had their turn."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

import torch
from torch import Tensor

from padgs.scene import Scene, View
from padgs.training.model import State
from padgs.training.targets import CoarseToFine, Target


class Order(Protocol):
    """Decides which data the next iterations see."""

    def state(self) -> State:
        """Return all that decides it; not copies."""
        ...

    def load(self, state: State) -> None:
        """Resume where the whole state was taken; raises ValueError if it is of other data."""
        ...


class TrainingViews:
    """The training views of a scene with their targets, one after the other."""

    def __init__(
        self,
        scene: Scene,
        weight: str = "uniform",
        device: torch.device | str = "cpu",
        coarse_share: float = 0.0,
        seed: int = 0,
        held_out: Collection[int] = (),
    ) -> None:
        """Shuffle the views, except those `held_out` until `include_held_out`.

        Args:
            scene, seed: the views, and the seed of their order.
            weight, device, coarse_share: of the targets, see `padgs.training.targets.CoarseToFine`.
            held_out: indices of training views.
        """
        self._scene, self._held_out = scene, tuple(held_out)
        self._sizes = CoarseToFine(scene.train, weight, torch.device(device), coarse_share)
        self.halvings = self._sizes.halvings
        self._generator = torch.Generator().manual_seed(seed)
        self._order = self._shuffled()  # of this epoch
        self._position = 0

    def next(self, progress: float) -> tuple[int, View, Target]:
        """Return index, view and target of the next step, which ends at a share of the run; prefetch the one after."""
        index = self.next_index()
        # At the end of an epoch the next order is unknown, and the present view is prefetched.
        upcoming = int(self._order[min(self._position, len(self._order) - 1)])
        self._scene.train[upcoming].prefetch()
        views, targets = self._sizes.at(progress)
        return index, views[index], targets[index]

    def next_index(self) -> int:
        """Return the index of the next view."""
        if self._position == len(self._order):
            self._order = self._shuffled()
            self._position = 0
        self._position += 1
        return int(self._order[self._position - 1])

    def include_held_out(self) -> None:
        """Include the views held out in the rest of this epoch, in random order, and in those after it."""
        if self._held_out:
            done, left = self._order[: self._position], self._order[self._position :]
            left = torch.cat((left, torch.tensor(self._held_out)))
            left = left[torch.randperm(len(left), generator=self._generator)]
            self._order = torch.cat((done, left))
            self._held_out = ()

    def _shuffled(self) -> Tensor:
        indices = [index for index in range(len(self._scene.train)) if index not in self._held_out]
        return torch.tensor(indices)[torch.randperm(len(indices), generator=self._generator)]

    def state(self) -> State:
        """Return all that decides the views to come; not copies."""
        values = {"position": self._position, "held_out": list(self._held_out), "views": len(self._scene.train)}
        return State({"random/views": self._generator.get_state(), "order": self._order}, values)

    def load(self, state: State) -> None:
        """Resume where the whole state was taken.

        Raises:
            ValueError: it is of a run with other views.
        """
        views = state.values["views"]
        if views != len(self._scene.train):
            raise ValueError(
                f"the state is of a run with {views} training views, but scene {self._scene.name!r} has "
                f"{len(self._scene.train)}; resume with the data it was trained on"
            )
        self._generator.set_state(state.tensors["random/views"].cpu())
        self._order = state.tensors["order"].to("cpu", copy=True)
        self._position, self._held_out = state.values["position"], tuple(state.values["held_out"])
