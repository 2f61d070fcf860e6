"""One run from its configuration to its result: load, train or resume, score, write; skip what is done."""

from __future__ import annotations

import time
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from padgs import clock, data, results
from padgs.baselines import METHODS
from padgs.data.capture import DataError
from padgs.evaluation.protocols import Protocol
from padgs.registry import lookup
from padgs.results import ASKED, Result
from padgs.runs import checkpoint, outcome
from padgs.runs.config import RunConfig
from padgs.runs.device import chosen
from padgs.runs.folder import Progress, RunFolder, RunFolderError
from padgs.runs.identity import identity, run_id
from padgs.runs.interrupt import ENOUGH, Interrupt, Interrupted
from padgs.runs.live import LiveLine
from padgs.runs.scoring import frame_times, probe, same_rules, scores
from padgs.runs.summary import introduce, show_result
from padgs.runs.terminal import say
from padgs.scene import Scene
from padgs.stopwatch import notice_stops
from padgs.training.failure import Failure
from padgs.training.loop import Record
from padgs.training.method import Method


class Watch:
    """What a run tells whoever started it, and what it asks: here nobody, who never stops it; subclasses do."""

    def started(self, folder: Path) -> None:
        """The run has this folder."""

    def saved(self, folder: Path) -> None:
        """A checkpoint was written, and the log is up to date."""

    def stop_requested(self) -> bool:
        """Whether the run should write its checkpoint and stop."""
        return False


class Session:
    """A run with its configuration, scene and folder, the console it speaks to, and whoever watches it."""

    def __init__(self, config: RunConfig, console: Console, watch: Watch = Watch()) -> None:  # noqa: B008 - no state
        """Load the scene; nothing is written before `run`.

        Raises:
            DataError: the input cannot be used.
        """
        if config.run.threads_per_job is not None:
            torch.set_num_threads(config.run.threads_per_job)
        torch.manual_seed(config.seed)
        notice_stops()
        device = chosen(config.run.device, config.render)
        clock.reset_peak_memory(device)
        self.config, self.console, self.watch = config, console, watch
        self.scene = scene_of(config, device)
        values, fingerprint = config.values(), self.scene.fingerprint
        name = run_id(values, self.scene.name, fingerprint, config.preset)
        self.folder = RunFolder(Path(config.run.folder) / name, identity(values, fingerprint))

    def run(self) -> Result:
        """Do what is missing of the run and show its result.

        Raises:
            ResultError, CheckpointError, RunFolderError: files of the run cannot be read or written.
            RunBusy: another process works on this run.
            Interrupted: stopped from outside; starting again goes on.
        """
        self.watch.started(self.folder.path)
        introduce(self.config, self.scene, self.folder.path, self.console)
        result = self.folder.result()
        if result is None or self._is_missing(result):
            with self.folder.locked():
                result = self.folder.result()  # by now another process may have finished it
                if result is not None and self._is_retried(result):
                    self.folder.forget(result)
                    result = None
                result = self.train() if result is None else self._completed(result)
        else:
            advice = "; it failed, retry=failed starts it again" if result.status in outcome.RETRIED else ""
            self._say(f"finished before, nothing to do{advice}")
        show_result(result, self.folder.path, self.console)
        return result

    def train(self) -> Result:
        """Train to the end of the budget, from the last checkpoint if there is one, score, and write the result.

        Whatever ends the training by itself is in the result. The last checkpoint holds the trained method.

        Raises:
            Interrupted: it was stopped from outside; the checkpoint was written.
            DataError: a panorama cannot be read any more; the last checkpoint stands.
            CheckpointError, RunFolderError: nothing can be read or written.
            ConfigError: what it shall begin with is no run on this scene.
        """
        config, folder = self.config, self.folder
        method, device = build(config), self.scene.points.device
        if config.init is not None and not checkpoint.exists(folder.checkpoint):
            stress = config.values().get("stress")
            method.begin_with(config.init.state(self.scene.fingerprint, self._fingerprint_at, device, stress))
        folder.prepare(config.values())
        progress = folder.resume(method, device)
        if progress.iteration:
            self._say(f"resuming after iteration {progress.iteration}")
        result = outcome.begun(config, self.scene, folder.path.name)
        try:
            saved, saved_iteration = time.monotonic(), progress.iteration
            with (
                Interrupt(self.watch.stop_requested) as stop,
                Interrupt(folder.stop.exists, ENOUGH) as enough,
                LiveLine(self.console) as line,
            ):
                for record in method.fit(self.scene, config.time):
                    progress = Progress(record.iteration, record.seconds, record.cpu_seconds, record.progress)
                    line.update(record, self._logged(record, method))
                    stopping = stop.requested
                    ending = enough.requested and not method.ended and method.stop(ASKED)
                    if stopping or ending or self._is_due(record, saved):
                        folder.save(method, progress)
                        self.watch.saved(folder.path)
                        saved, saved_iteration = time.monotonic(), record.iteration
                    if stopping and record.progress < 1:
                        raise Interrupted(f"stopped after iteration {record.iteration}, the checkpoint is written")
                if saved_iteration != progress.iteration:
                    folder.save(method, progress)
            result = replace(result, **self._trained(method, progress))
            if self.scene.test:
                scored = replace(result, **self._tested(method, progress))
                result = outcome.judged(scored, self.scene, progress.iteration)
        except (Interrupted, DataError):  # panoramas that cannot be read now may be there again: nothing has failed yet
            raise
        except KeyboardInterrupt as error:
            raise Interrupted("stopped at once, the last checkpoint stands") from error
        except (Failure, ValueError, MemoryError, RuntimeError) as error:
            what = {"status": outcome.status(error), "reason": outcome.reason(error)}
            result = replace(result, **what, **outcome.peak_memory(self.scene))
        finished = datetime.now(timezone.utc).isoformat(timespec="seconds")
        if result.ended == ASKED:
            words = (config.row, f"stopped after {progress.iteration} iterations")
            result = replace(result, variant=", ".join(filter(None, words)))
        asked = progress.iteration if config.budget.seconds is not None else result.iterations
        return folder.finish(replace(result, iterations=asked, iterations_done=progress.iteration, finished=finished))

    def _fingerprint_at(self, width: int | None) -> str:
        """The fingerprint of the scene at another width."""
        data = replace(self.config.data, width=width)
        return scene_of(replace(self.config, data=data), self.scene.points.device).fingerprint

    def _logged(self, record: Record, method: Method) -> float | None:
        """Log an iteration where that is due; PSNR of the held-out view where it was measured."""
        options, views = self.config.run, self.scene.test
        last = record.progress == 1
        due = bool(views) and (last or record.iteration % options.probe_every == 0)
        probed = probe(method, views[len(views) // 2]) if due else {}
        if last or due or record.events or record.iteration % options.log_every == 0:
            self.folder.log(record, probed)
        return probed.get("psnr")

    def _is_due(self, record: Record, saved: float) -> bool:
        """Whether it is time for a checkpoint, the last one having been written at `saved`."""
        every = self.config.run.checkpoint_every
        if every is not None and record.iteration % every == 0:
            return True
        return time.monotonic() - saved > self.config.run.seconds_between_checkpoints

    def _trained(self, method: Method, progress: Progress) -> dict[str, Any]:
        """The fields of a result about a trained method."""
        size = method.size()
        start = {"start": method.start} if "gaussians" in size.counts else {}
        return {
            "status": "ok" if progress.share == 1 else "timeout",
            "counts": {**size.counts, "parameters": size.parameters, **start},
            "model_bytes": size.bytes,
            "ended": method.ended,
            "timing": _training_time(progress),
            **outcome.peak_memory(self.scene),  # of training; scoring has networks of its own
        }

    def _tested(self, method: Method, progress: Progress) -> dict[str, Any]:
        """The fields of a result that take test views, times of training included."""
        save_picture = self.folder.save_picture if self.config.run.pictures else None
        timing = {**_training_time(progress), **frame_times(method, self.scene)}
        return {"timing": timing, "scores": scores(method, self.scene, self.config.protocols, save_picture)}

    def _is_missing(self, result: Result) -> bool:
        """Whether there is anything left to do about a finished run."""
        return self._is_retried(result) or bool(self._unscored(result)) or self._serving(result) != result.experiments

    def _serving(self, result: Result) -> tuple[str, ...]:
        """The experiments of a finished run, and who asks for it now."""
        return results.joined(result.experiments, self.config.labels.experiments)

    def _is_retried(self, result: Result) -> bool:
        return result.status in outcome.RETRIED and self.config.retry == "failed"

    def _unscored(self, result: Result) -> dict[str, Protocol]:
        """The protocols under whose rules a run that ended well has no marks."""
        return {
            name: protocol
            for name, protocol in self.config.protocols.items()
            if result.ok and (name not in result.scores or not same_rules(result.scores[name], protocol))
        }

    def _completed(self, result: Result) -> Result:
        """A finished run with marks under the rules that it lacks; it may serve several experiments."""
        complete = replace(result, experiments=self._serving(result))
        if unscored := self._unscored(result):
            self._say("finished before; only the new protocol is missing")
            if not checkpoint.exists(self.folder.checkpoint):  # an untrained method would be scored
                raise RunFolderError(
                    f"{self.folder.path} has a result but no checkpoint any more, so it cannot be scored under other "
                    f"rules of {', '.join(unscored)}; keep the old rules, or delete the folder to train again"
                )
            method = build(self.config)
            self.folder.resume(method, self.scene.points.device)
            marks = {**result.scores, **scores(method, self.scene, unscored, None)}
            complete = outcome.judged(replace(complete, scores=marks), self.scene, result.iterations_done)
        return result if complete == result else self.folder.finish(complete)

    def _say(self, text: str) -> None:
        say(self.console, text)


def _training_time(progress: Progress) -> dict[str, float]:
    return {"train_seconds": progress.seconds, "cpu_seconds": progress.cpu_seconds}


def scene_of(config: RunConfig, device: torch.device) -> Scene:
    """The scene of a configuration, on a device, its panoramas where `run.images_on` says.

    Raises:
        DataError: the input cannot be used.
        ValueError: the stress condition cannot be applied to it.
    """
    images_on = str(device) if config.run.images_on == "device" else config.run.images_on
    scene = data.load(config.data.path, config.data.format, config.data.options(images_on))
    return config.stress.apply(scene, config.seed).recentered().to(device)


def build(config: RunConfig) -> Method:
    """Return the untrained method of a configuration."""
    return lookup(METHODS, config.method, "method")(config.options, config.render, config.train, seed=config.seed)
