"""The folder of a search: a checkpoint with its numbers for each step, and that of an interrupted refinement."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from padgs.need.plan import Step
from padgs.results import Scores
from padgs.runs import checkpoint
from padgs.training.model import State

STEP, BEGUN, OF = "step", "begun", "of"  # values of a checkpoint: the numbers of a step, what was begun, of what model


class StepsFolder:
    """Reads and writes the steps of the search on one model, whose checkpoint has the digest `of`."""

    def __init__(self, path: Path, of: str) -> None:
        self.path, self._of = path, of

    def steps(self) -> list[Step]:
        """What was made so far.

        Raises:
            CheckpointError: it is damaged, or of another model.
        """
        found = []
        while checkpoint.exists(self._folder(len(found))):
            values: dict[str, Any] = dict(self.state(len(found)).values[STEP])
            values["marks"] = Scores(**values["marks"] | {"notes": ()})
            found.append(Step(**values))
        return found

    def state(self, number: int, device: torch.device | str = "cpu") -> State:
        """The model of a step.

        Raises:
            CheckpointError: it is damaged, or of another model.
        """
        return self._checked(checkpoint.load(self._folder(number), device), self._folder(number))

    def add(self, number: int, step: Step, model: State) -> None:
        """Write a step; a refinement that was begun is over with it.

        Raises:
            CheckpointError: it cannot be written.
        """
        values = {"model": model.values, STEP: asdict(step), OF: self._of}
        checkpoint.save(State(model.tensors, values), self._folder(number))
        shutil.rmtree(self._begun, ignore_errors=True)

    def begin(self, what: str, state: State) -> None:
        """Keep a refinement that was interrupted, in the place of any other.

        Raises:
            CheckpointError: it cannot be written.
        """
        checkpoint.save(State(state.tensors, {**state.values, BEGUN: what, OF: self._of}), self._begun)

    def begun(self, what: str, device: torch.device | str = "cpu") -> State | None:
        """That refinement, if it was the last to be interrupted.

        Raises:
            CheckpointError: it is damaged, or of another model.
        """
        if not checkpoint.exists(self._begun):
            return None
        state = self._checked(checkpoint.load(self._begun, device), self._begun)
        return state if state.values[BEGUN] == what else None

    @property
    def _begun(self) -> Path:
        return self.path / BEGUN

    def _folder(self, number: int) -> Path:
        return self.path / f"{number:03d}"

    def _checked(self, state: State, folder: Path) -> State:
        if state.values.get(OF) != self._of:
            raise checkpoint.CheckpointError(
                f"{folder} is of another model than the run has now; delete {self.path} to search anew"
            )
        return state
