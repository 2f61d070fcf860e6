"""Which training view comes when: in random order, without replacement until all had their turn."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

import torch
from torch import Tensor

from padgs.scene import Scene
from padgs.training.model import State


class Order(Protocol):
    """What decides which data the next iterations see."""

    def state(self) -> State:
        """All of it; not copies."""
        ...

    def load(self, state: State) -> None:
        """Take that back out of a whole state; raises ValueError if it is of other data."""
        ...


class ViewOrder:
    """Numbers of the training views of a scene, one after the other."""

    def __init__(self, scene: Scene, seed: int, apart: Collection[int] = ()) -> None:
        """All views have their turn but those set `apart`, until `take_all`."""
        self._scene, self._apart = scene, tuple(apart)
        self._shuffler = torch.Generator().manual_seed(seed)
        self._order = self._shuffled()  # of this epoch
        self._position = 0  # in it

    def next(self) -> int:
        """The next view."""
        if self._position == len(self._order):
            self._order = self._shuffled()
            self._position = 0
        self._position += 1
        return int(self._order[self._position - 1])

    def upcoming(self) -> int:
        """The view after that; at the end of an epoch, where it is not drawn yet, the present one."""
        return int(self._order[min(self._position, len(self._order) - 1)])

    def take_all(self) -> None:
        """From now on no view is set apart; those that were come in what is left of this epoch, in random order."""
        if self._apart:
            done, left = self._order[: self._position], self._order[self._position :]
            left = torch.cat((left, torch.tensor(self._apart)))
            left = left[torch.randperm(len(left), generator=self._shuffler)]
            self._order = torch.cat((done, left))
            self._apart = ()

    def _shuffled(self) -> Tensor:
        numbers = [number for number in range(len(self._scene.train)) if number not in self._apart]
        return torch.tensor(numbers)[torch.randperm(len(numbers), generator=self._shuffler)]

    def state(self) -> State:
        """What decides the views to come."""
        tensors = {"random/views": self._shuffler.get_state(), "order": self._order}
        return State(tensors, {"position": self._position, "apart": list(self._apart), "views": len(self._scene.train)})

    def load(self, state: State) -> None:
        """Take that back out of a whole state.

        Raises:
            ValueError: it is of a run with other views.
        """
        views = state.values.get("views", len(state.tensors["order"]))  # older states: all are in order
        if views != len(self._scene.train):
            raise ValueError(
                f"the state is of a run with {views} training views, but scene {self._scene.name!r} has "
                f"{len(self._scene.train)}; resume with the data it was trained on"
            )
        self._shuffler.set_state(state.tensors["random/views"].cpu())
        self._order = state.tensors["order"].to("cpu", copy=True)
        self._position, self._apart = state.values["position"], tuple(state.values.get("apart", ()))
