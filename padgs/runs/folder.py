"""The folder of one run: config.yaml, log.jsonl, checkpoint/, renders/, and at the very end result.json.

Whoever puts a file `stop` there asks the run to end well, now.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from PIL import Image
from torch import Tensor

from padgs import results
from padgs.evaluation.images import comparison_image
from padgs.replacing import replace_file
from padgs.results import Result
from padgs.runs import checkpoint
from padgs.runs import lock as run_lock
from padgs.scene import View
from padgs.training.loop import Record
from padgs.training.method import Method
from padgs.training.trainee import State


class RunFolderError(RuntimeError):
    """The run folder cannot be written; the message names the file, the reason and the way out."""


PROGRESS = "progress"  # where a checkpoint says how far the run was


@dataclass(frozen=True)
class Progress:
    """How far training went."""

    iteration: int = 0
    seconds: float = 0.0  # of training
    cpu_seconds: float = 0.0
    share: float = 0.0  # of the schedule


class RunFolder:
    """Reads and writes the files of one run."""

    def __init__(self, path: Path, run: Mapping[str, str] | None = None) -> None:
        """Of a run of this identity; without one, checkpoints of any run are read."""
        self.path, self._run = path, run
        self.checkpoint = path / "checkpoint"
        self.renders = path / results.PICTURES
        self.stop = path / "stop"
        self._log = path / results.LOG_NAME

    def prepare(self, values: Mapping[str, Any]) -> None:
        """Make the folder and write config.yaml.

        Raises:
            RunFolderError: it cannot be written.
        """
        with self._writing():
            self.renders.mkdir(parents=True, exist_ok=True)
            replace_file(self.path / results.CONFIG_NAME, OmegaConf.to_yaml(OmegaConf.create(dict(values))).encode())

    def result(self) -> Result | None:
        """The result, if the run is done.

        Raises:
            ResultError: there is one, but it cannot be used.
        """
        path = self.path / results.FILE_NAME
        return results.read(path) if path.exists() else None

    def finish(self, result: Result) -> Result:
        """Write result.json; from then on the run is done. Returns what the file says, as any later reader sees it."""
        with self._writing():
            path = results.write(result, self.path)
            self.stop.unlink(missing_ok=True)  # it has been heard, or came too late
        return results.read(path)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Make the folder, and keep other processes out of it.

        Raises:
            RunBusy: another process works on this run.
            RunFolderError: the folder cannot be written.
        """
        with ExitStack() as stack:
            with self._writing():
                self.path.mkdir(parents=True, exist_ok=True)
                stack.enter_context(run_lock.held(self.path))
            yield

    def forget(self, result: Result) -> None:
        """Let a failed run start again; where only memory ran out, from its checkpoint."""
        with self._writing():
            if result.status != "oom":
                shutil.rmtree(self.checkpoint, ignore_errors=True)
            self.stop.unlink(missing_ok=True)
            (self.path / results.FILE_NAME).unlink()

    def log(self, record: Record, probed: Mapping[str, float]) -> None:
        """Append a line to log.jsonl; `probed` is what a held-out view said, empty where it was not asked."""
        line: dict[str, Any] = {"iteration": record.iteration, "progress": round(record.progress, 6)}
        line |= {"loss": float(record.loss), "seconds": round(record.seconds, 4), **record.counts, **probed}
        if record.events:
            line["events"] = list(record.events)
        with self._writing(), self._log.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def save(self, method: Method, progress: Progress) -> None:
        """Write the checkpoint.

        Raises:
            CheckpointError: it cannot be written; the previous one stands.
        """
        state = method.state()
        checkpoint.save(State(state.tensors, {**state.values, PROGRESS: asdict(progress)}), self.checkpoint, self._run)

    def resume(self, method: Method, device: torch.device | str = "cpu") -> Progress:
        """Put a method where the checkpoint was taken, on this device; the beginning, if there is none.

        What the log says about later iterations is dropped, they will come again; so is a line that a kill has cut.

        Raises:
            CheckpointError: there is one, but it is damaged, or of another run.
        """
        progress = Progress()
        if checkpoint.exists(self.checkpoint):
            state = checkpoint.load(self.checkpoint, device, self._run)
            with checkpoint.understood(self.checkpoint):
                method.load_state(state)
                progress = Progress(**state.values[PROGRESS])
        if self._log.exists():
            kept = [line for line in results.log_lines(self.path) if line["iteration"] <= progress.iteration]
            with self._writing():
                replace_file(self._log, "".join(json.dumps(line) + "\n" for line in kept).encode())
        return progress

    def save_picture(self, view: View, truth: Tensor, image: Tensor) -> None:
        """Save truth | render | error of a view; images [H, W, 3]."""
        with self._writing():
            Image.fromarray(comparison_image(truth, image)).save(self.renders / results.picture_name(view.name))

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise cannot_write(self.path, error) from error


def cannot_write(path: Path, error: OSError) -> RunFolderError:
    """The error to raise where a run folder, or what lies beside it, cannot be written."""
    return RunFolderError(
        f"cannot write run folder {path}: {error.strerror or error}; "
        "make room, mend the permissions, or set run.folder to another place"
    )
