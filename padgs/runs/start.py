"""Going on: a run that begins with the model of a finished one, in place of the points of its scene.

It has a schedule of its own, of `train.iterations` or `budget.seconds`, and does all of it: learning rates rise again,
and the model grows again where its method says so. docs/your_photographs.md says when that is worth it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from padgs import results
from padgs.results import Result, ResultError
from padgs.runs import checkpoint
from padgs.runs.checkpoint import CheckpointError
from padgs.runs.folder import RunFolder
from padgs.runs.identity import identity
from padgs.runs.typed import ConfigError
from padgs.training.trainee import State


@dataclass(frozen=True)
class Start:
    """The finished run that another begins with."""

    run: str  # its folder; decides nothing
    checkpoint: str  # SHA-256 of the tensors of its checkpoint

    @classmethod
    def of(cls, folder: str, method: str) -> Start:
        """That of a folder, for a run of a method.

        Raises:
            ConfigError: it holds no run that ended well, one of another method, or one without its checkpoint.
        """
        files = RunFolder(Path(folder))
        try:
            result = _finished(files)
            if result.method != method:
                raise ConfigError(
                    f"init={folder} is a run of {result.method}, whose model is nothing for {method}; set "
                    f"method={result.preset}, or leave init out"
                )
            return cls(folder, checkpoint.digest(files.checkpoint))
        except (ResultError, CheckpointError) as error:
            raise ConfigError(f"init={folder}: {error}") from error

    def state(
        self,
        fingerprint: str,
        scene_at: Callable[[int | None], str],
        device: torch.device,
        stress: Mapping[str, Any] | None = None,
    ) -> State:
        """The state that the run ended with.

        Args:
            fingerprint: of the scene of the new run.
            scene_at: the same of another `data.width`, asked for only where that of the two runs differ.
            device: of the tensors.
            stress: that the new run is under, as its configuration has it; None: none.

        Raises:
            ConfigError: it was trained on something else or under another stress, or its checkpoint has changed since.
        """
        files = RunFolder(Path(self.run))
        try:
            result = _finished(files)
            if checkpoint.digest(files.checkpoint) != self.checkpoint:
                raise ConfigError(f"init={self.run} has changed since this run was composed; start it again")
            if fingerprint != result.fingerprint and scene_at(result.config["data"]["width"]) != result.fingerprint:
                raise ConfigError(
                    f"init={self.run} was trained on other data: images, poses, points, split and masks must be the "
                    "same, only data.width may differ; take a run on this scene, or leave init out"
                )
            if (before := result.config.get("stress")) != stress:
                raise ConfigError(
                    f"init={self.run} was trained under stress {before or 'none'}, and this run is under "
                    f"{stress or 'none'}: views, poses or units may be others; take the same stress, or leave init out"
                )
            return checkpoint.load(files.checkpoint, device, identity(result.config, result.fingerprint))
        except (ResultError, CheckpointError) as error:
            raise ConfigError(f"init={self.run}: {error}") from error


def _finished(files: RunFolder) -> Result:
    """The result of a run that ended well.

    Raises:
        ConfigError: there is none.
        ResultError: it cannot be read.
    """
    result = files.result()
    if result is None:
        what = "is not finished" if (files.path / results.CONFIG_NAME).exists() else "is no folder of a run"
        raise ConfigError(f"init={files.path} {what}; give one of which padgs-run has shown the scores")
    if not result.ok:
        raise ConfigError(
            f"init={files.path} ended with status {result.status} ({result.reason}), so its model is of no use; "
            "give a run that ended well"
        )
    return result
