"""Warm start: a run begins with the model of a finished run instead of points, and goes through its own schedule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from padgs import results
from padgs.checks import ConfigError
from padgs.results import Result, ResultError
from padgs.runs import checkpoint
from padgs.runs.checkpoint import CheckpointError
from padgs.runs.store import RunStore, identity
from padgs.training.model import State


@dataclass(frozen=True)
class WarmStart:
    """The finished run that another begins with."""

    run: str  # its folder; no number depends on it
    checkpoint: str  # SHA-256 of the tensors of its checkpoint

    @classmethod
    def of(cls, folder: str, method: str) -> WarmStart:
        """Return the warm start of a method from the folder of a run that ended well; else raise a ConfigError."""
        store = RunStore(Path(folder))
        try:
            result = _finished(store)
            if result.method != method:
                raise ConfigError(
                    f"init={folder} is a run of {result.method}, whose model does not fit {method}; set "
                    f"method={result.preset}, or leave init out"
                )
            return cls(folder, checkpoint.digest(store.checkpoint))
        except (ResultError, CheckpointError) as error:
            raise ConfigError(f"init={folder}: {error}") from error

    def state(
        self,
        fingerprint: str,
        fingerprint_at: Callable[[int | None], str],
        device: torch.device,
        stress: Mapping[str, Any] | None = None,
    ) -> State:
        """Return the state that the run ended with; raise a ConfigError for other data, another stress or a change.

        `fingerprint` is that of the scene of the new run; `fingerprint_at` returns the same for another `data.width`,
        and is called only if the fingerprints differ; `stress` is that of the new run with its seed.
        """
        store = RunStore(Path(self.run))
        try:
            result = _finished(store)
            if checkpoint.digest(store.checkpoint) != self.checkpoint:
                raise ConfigError(f"init={self.run} has changed since this run was composed; start it again")
            theirs = result.fingerprint
            if theirs != fingerprint and theirs != fingerprint_at(result.config["data"]["width"]):
                raise ConfigError(
                    f"init={self.run} was trained on other data: images, poses, points, split and masks must be the "
                    "same, only data.width may differ; take a run on this scene, or leave init out"
                )
            other = result.config.get("stress")
            if (other := other and {**other, "seed": result.seed}) != stress:
                raise ConfigError(
                    f"init={self.run} was trained under stress {other or 'none'}, and this run is under "
                    f"{stress or 'none'}: views, poses or units may differ; take the same stress and seed, or no init"
                )
            return checkpoint.load(store.checkpoint, device, identity(result.config, result.fingerprint))
        except (ResultError, CheckpointError) as error:
            raise ConfigError(f"init={self.run}: {error}") from error


def _finished(store: RunStore) -> Result:
    """Return the result of a run that ended well; if there is none, raise a ConfigError."""
    if (result := store.result()) is None:
        what = "is not finished" if (store.path / results.CONFIG_NAME).exists() else "is no folder of a run"
        raise ConfigError(f"init={store.path} {what}; give a run of which padgs-run has shown the scores")
    if not result.ok:
        raise ConfigError(
            f"init={store.path} ended with status {result.status} ({result.reason}), so its model is of no use; "
            "give a run that ended well"
        )
    return result
