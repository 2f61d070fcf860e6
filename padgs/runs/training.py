"""The loop around `Method.fit`: log, held-out PSNR, checkpoints, and stopping where nothing is lost."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from rich.console import Console

from padgs.learning.loop import Record
from padgs.learning.method import Method
from padgs.learning.trainee import State
from padgs.runs import checkpoint
from padgs.runs.config import RunConfig
from padgs.runs.folder import RunFolder
from padgs.runs.interrupt import Interrupt, Interrupted
from padgs.runs.live import LiveLine
from padgs.scene import Scene, View
from padgs.scoring.metrics import psnr
from padgs.tracking.watch import Watch

PROGRESS = "progress"  # where a checkpoint says how far the run was


@dataclass(frozen=True)
class Progress:
    """How far training went."""

    iteration: int = 0
    seconds: float = 0.0  # of training


def resume(method: Method, folder: RunFolder, device: torch.device | str = "cpu") -> Progress:
    """Put the method where the run's checkpoint was taken, on this device; the beginning, if there is none.

    Raises:
        CheckpointError: there is one, but it is damaged.
    """
    if not checkpoint.exists(folder.checkpoint):
        folder.forget_after(0)
        return Progress()
    state = checkpoint.load(folder.checkpoint, device)
    method.load_state(state)
    progress = Progress(**state.values[PROGRESS])
    folder.forget_after(progress.iteration)
    return progress


def train(
    method: Method,
    scene: Scene,
    config: RunConfig,
    folder: RunFolder,
    progress: Progress,
    console: Console,
    watch: Watch = Watch(),  # noqa: B008 - has no state
) -> Progress:
    """Train from `progress` to the end of the budget. The last checkpoint holds the trained method.

    Raises:
        Failure: the run ends with a status other than ok.
        Interrupted: it was stopped from outside; the checkpoint was written.
        CheckpointError, RunFolderError: nothing more can be written.
    """
    options, saved = config.run, time.monotonic()
    held_out = scene.test[len(scene.test) // 2] if scene.test else None
    saved_iteration = progress.iteration
    with Interrupt(watch.stop_requested) as stop, LiveLine(console, config.train.iterations) as line:
        for record in method.fit(scene, config.train.budget):
            progress = Progress(record.iteration, record.seconds)
            last = record.iteration == config.train.iterations
            probe = held_out is not None and (record.iteration % options.probe_every == 0 or last)
            quality = held_out_psnr(method, held_out) if probe and held_out is not None else None
            if record.iteration % options.log_every == 0 or last or probe or record.events:
                folder.log(_line(record, quality))
            line.update(record, quality)
            stopping = stop.requested
            due = options.checkpoint_every is not None and record.iteration % options.checkpoint_every == 0
            if due or stopping or time.monotonic() - saved > options.checkpoint_seconds:
                save(method, progress, folder)
                watch.saved(folder.path)
                saved, saved_iteration = time.monotonic(), record.iteration
            if stopping and not last:
                raise Interrupted(f"stopped after iteration {record.iteration}, the checkpoint is written")
        if saved_iteration != progress.iteration:
            save(method, progress, folder)
    return progress


def save(method: Method, progress: Progress, folder: RunFolder) -> None:
    """Write the checkpoint of a run."""
    state = method.state()
    values = {**state.values, PROGRESS: {"iteration": progress.iteration, "seconds": progress.seconds}}
    checkpoint.save(State(state.tensors, values), folder.checkpoint)


def held_out_psnr(method: Method, view: View) -> float:
    """PSNR in dB of one test view, all of its pixels that its mask lets through."""
    image = method.render(view).image.clamp(0, 1)
    return psnr(
        image,
        view.image(dtype=image.dtype, device=image.device),
        view.mask(dtype=image.dtype, device=image.device),
    ).item()


def _line(record: Record, quality: float | None) -> dict[str, object]:
    line: dict[str, object] = {
        "iteration": record.iteration,
        "loss": float(record.loss),
        "seconds": round(record.seconds, 4),
    }
    line |= record.counts
    if quality is not None:
        line["psnr"] = quality
    if record.events:
        line["events"] = list(record.events)
    return line
