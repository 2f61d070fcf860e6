"""One run, from its configuration to `result.json`: load the scene, train, score, write.

A run that was interrupted resumes from its checkpoint; a finished run is shown again, or scored under new protocols.
"""

from __future__ import annotations

import gc
import json
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from padgs import clock, data, results
from padgs.baselines import METHODS, distribution
from padgs.checks import lookup
from padgs.data.capture import DataError
from padgs.evaluation.lpips import NO_WEIGHTS, has_weights
from padgs.evaluation.protocols import Protocol
from padgs.evaluation.scoring import constant_color_quality, frame_times, probe, score
from padgs.results import STATUSES, STOP_REQUESTED, Result
from padgs.runs.candidates import deciding_views
from padgs.runs.checkpoint import CheckpointError
from padgs.runs.config import RunConfig, choose_device
from padgs.runs.console import LiveLine, introduce, say, show_result
from padgs.runs.interrupt import STOP_SIGNALS, Interrupt, Interrupted
from padgs.runs.store import Progress, RunBusy, RunFolderError, RunStore, config_hash
from padgs.scene import Scene
from padgs.training.health import Failure, is_out_of_memory, memory_reason, validation_split
from padgs.training.loop import Record
from padgs.training.method import Method
from padgs.training.options import AUTO

MAX_DEPTH_ERROR = 0.5  # AbsRel; more is degenerate
MIN_THICKNESS = 0.01  # of all surfaces along their thinnest axis, relative to the true one; less is degenerate
MIN_ITERATIONS = 50  # a shorter run is not judged by its quality
# Errors whose message suffices without a traceback. Failures of training are results; Failure is one of a later search.
REPORTED = (ValueError, OSError, Failure, CheckpointError, RunFolderError, RunBusy)
RETRIED = STATUSES.keys() - {"ok", "timeout"}  # statuses that retry=failed starts again


class Callback:
    """Follows a run and may stop it; this one does nothing."""

    is_candidate = False  # of a search for the smallest model, which a request to stop and score cuts none short

    def started(self, folder: Path) -> None:
        """Take note of the run folder, before anything is written there."""

    def stop_requested(self) -> bool:
        """Return whether the run should write its checkpoint and stop."""
        return False


def run(
    config: RunConfig,
    console: Console,
    callback: Callback = Callback(),  # noqa: B008 - no state
    scene: Scene | None = None,
    brief: bool = False,
) -> Result:
    """Do what is missing of a run, and show its result.

    `scene` is as `load_scene(config, start(config))` returns it; loaded if None. `console` receives progress and the
    result, if `brief` only progress; `callback` is told of the folder. Errors of the input and of files are `REPORTED`.
    Starting the run again after `Interrupted` resumes it.
    """
    scene = load_scene(config, start(config)) if scene is None else scene
    store = RunStore.of(config, scene)
    callback.started(store.path)
    words = Console(quiet=True) if brief else console
    introduce(config, scene, store.path, words)
    result = store.result()
    if (
        result is not None
        and not (_is_retried(config, result) or _unscored(config, scene, result, can_score=store.has_checkpoint))
        and results.joined(result.experiments, config.labels.experiments) == result.experiments
    ):
        advice = "; it failed, retry=failed starts it again" if result.status in RETRIED else ""
        if (code := distribution(config.method)) and not result.code_version.endswith(code):
            advice += f"; it was trained by other code of the method ({result.code_version}): delete it to train again"
        if not store.config.exists():
            store.prepare(config.values())
        say(words, f"finished before, nothing to do{advice}")
        show_result(result, store.path, words)
        return result
    with store:
        earlier = store.result()
        result = _completed(config, scene, store, words)
        if result is None:
            method, progress = _prepared(config, scene, store, words)
            saved_at, saved, interrupted, before = time.monotonic(), progress, False, progress
            begun, made_by = _joined(initial_result(config, scene, store.path.name), before)
            if earlier is not None:  # a failed run that starts again
                begun = replace(begun, experiments=results.joined(earlier.experiments, begun.experiments))
            with _Outcome(begun, scene, before) as outcome:
                with (
                    Interrupt(callback.stop_requested) as interrupt,
                    Interrupt(store.stop.exists, STOP_SIGNALS) as stop,
                    LiveLine(console, transient=brief) as line,
                ):
                    for record in method.fit(scene, config.time):
                        spent = record.seconds, record.cpu_seconds
                        progress = Progress(record.iteration, *spent, record.progress, made_by=made_by)
                        probed = _log(config, scene, store, record, method)
                        interrupted = interrupt.requested
                        ending = stop.requested and not (method.ended or callback.is_candidate)
                        ending = ending and method.request_stop(STOP_REQUESTED)
                        every = config.run.checkpoint_every
                        due = every is not None and record.iteration % every == 0
                        due = due or time.monotonic() - saved_at > config.run.checkpoint_seconds
                        if interrupted or ending or due:
                            store.save(method, replace(progress, **_peaks(before, scene)))
                            saved_at, saved = time.monotonic(), progress
                        if interrupted:
                            break
                        line.update(record, probed)
                    if saved != progress:
                        store.save(method, replace(progress, **_peaks(before, scene)))
                    if interrupted or interrupt.requested:
                        raise Interrupted(f"stopped after iteration {progress.iteration}, the checkpoint is written")
                outcome.result = replace(outcome.result, **_trained(method, progress), **_peaks(before, scene))
                if scene.test:
                    outcome.result = scored(config, scene, store, outcome.result, method)
            result = store.finish(_final(config, outcome.result, progress))
    show_result(result, store.path, words)
    return result


class _Outcome:
    """Context that turns failures of training into the status of `result`.

    Not interrupts, unreadable images, and text that a terminal cannot show.
    """

    def __init__(self, result: Result, scene: Scene, before: Progress) -> None:
        self.result, self._scene, self._before = result, scene, before

    def __enter__(self) -> _Outcome:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: object) -> bool:
        if isinstance(error, KeyboardInterrupt) and not isinstance(error, Interrupted):
            raise Interrupted("stopped at once, the last checkpoint stands") from error
        if isinstance(error, DataError | UnicodeError) or not isinstance(error, Exception):
            return False
        if isinstance(error, Failure):
            status, reason = error.status, str(error)
        elif isinstance(error, ValueError):
            status, reason = "rejected", str(error)
        elif is_out_of_memory(error):
            status, reason = "oom", f"out of memory: {memory_reason(error)}"
        else:
            return False
        self.result = replace(self.result, status=status, reason=reason, **_peaks(self._before, self._scene))
        return True


def start(config: RunConfig) -> torch.device:
    """Set threads and seed of the process, reset its peak memory, and return the device of the run."""
    if config.run.threads_per_job is not None:
        torch.set_num_threads(config.run.threads_per_job)
    torch.manual_seed(config.seed)
    device = choose_device(config.run.device, config.render, strict="SLURM_JOB_GPUS" in os.environ)
    gc.collect()  # models of earlier runs in this process, which refer to themselves
    clock.reset_peak_memory(device)
    return device


def load_scene(config: RunConfig, device: torch.device) -> Scene:
    """Load a run's scene and images onto a device, under its stress; a ValueError says what cannot be used."""
    scene = data.load(config.data.path, config.data.format, config.data.options(str(device)))
    scene = config.stress.apply(scene, config.seed).recentered().to(device)
    # Both refuse too few views, before hours of training.
    if config.budget.stop == AUTO:
        validation_split(scene.train)
    if config.smallest == "on":
        deciding_views(scene)
    return scene


def build_method(config: RunConfig) -> Method:
    """Return the untrained method of a run."""
    return lookup(METHODS, config.method, "method")(config.options, config.render, config.train, seed=config.seed)


def _prepared(config: RunConfig, scene: Scene, store: RunStore, console: Console) -> tuple[Method, Progress]:
    """Return the method of a run with its warm start or checkpoint, and its progress; write config.yaml."""
    method = build_method(config)
    if config.init is not None and not store.has_checkpoint:
        values, device = config.values(), scene.points.device
        stress = {**values["stress"], "seed": config.seed} if "stress" in values else None

        def fingerprint_at(width: int | None) -> str:
            return load_scene(replace(config, data=replace(config.data, width=width)), device).fingerprint

        method.warm_start(config.init.state(scene.fingerprint, fingerprint_at, device, stress))
    store.prepare(config.values())
    progress = store.resume(method, scene.points.device)
    if progress.iteration:
        say(console, f"resuming after iteration {progress.iteration}")
    return method, progress


def scored(config: RunConfig, scene: Scene, store: RunStore, result: Result, method: Method) -> Result:
    """Return the result of a trained method with its frame times and scores."""
    save_image = store.save_image if config.run.pictures else None
    timing = result.timing | frame_times(method.render, scene)
    scores = score(method.render, scene, config.protocols, save_image, calibrates=method.calibrates)
    return judge(replace(result, timing=timing, scores=scores), scene, result.iterations_done)


def _final(config: RunConfig, result: Result, progress: Progress) -> Result:
    done = progress.iteration
    if result.ended == STOP_REQUESTED:
        result = replace(result, variant=", ".join(filter(None, (config.row, f"stopped after {done} iterations"))))
    iterations = result.iterations if config.budget.seconds is None else done
    return replace(result, iterations=iterations, iterations_done=done)


def initial_result(config: RunConfig, scene: Scene, run: str) -> Result:
    """Return the result of a run before its first iteration, with status ok."""
    view = (scene.test or scene.train)[0]
    is_panoramic = all(view.lens is None for view in (*scene.train, *scene.test))
    machine = clock.machine(scene.points.device)
    code = (machine["padgs"], (machine["commit"] or "")[:10], distribution(config.method))
    values = config.values()
    return Result(
        run=run,
        status="ok",
        method=config.method,
        preset=config.preset,
        variant=config.row,
        dataset=config.data.dataset or ("" if config.data.path else "synthetic"),
        scene=scene.name,
        width=view.width,
        height=view.height,
        iterations=config.train.iterations,
        iterations_done=0,
        seed=config.seed,
        code_version=" ".join(filter(None, code)) or "unknown",
        machine=machine,
        config_hash=config_hash(values),
        fingerprint=scene.fingerprint,
        cameras={} if is_panoramic else {view.name: view.camera.kind for view in scene.test},
        finished="",
        config=values,
        experiments=config.labels.experiments,
    )


def _joined(result: Result, before: Progress) -> tuple[Result, tuple[str, str]]:
    """Return the result with all code and hardware of a resumed run, so that reports mix it with no other; and both."""
    chip = "gpu" if result.machine["gpu"] else "cpu"
    pairs = zip(before.made_by, (result.code_version, result.machine[chip]), strict=True)
    code, place = (then(old, now) for old, now in pairs)
    return replace(result, code_version=code, machine={**result.machine, chip: place}), (code, place)


def then(old: str, now: str) -> str:
    """Return both in order, or of a long list the first and the last; results hold names of up to 255 letters."""
    words = now if old in ("", now) else f"{old.removesuffix(f' then {now}')} then {now}"
    return words if len(words) <= 200 else f"{words.partition(' then ')[0]} then others then {now}"


def _log(config: RunConfig, scene: Scene, store: RunStore, record: Record, method: Method) -> float | None:
    """Log an iteration if that is due; return the PSNR of the held-out view if it was measured."""
    last = record.progress == 1
    panoramas = [view for view in scene.test if view.lens is None]
    due = bool(panoramas) and (last or record.iteration % config.run.probe_every == 0)
    probed = probe(method.render, panoramas[len(panoramas) // 2]) if due else {}
    if last or due or record.events or record.iteration % config.run.log_every == 0:
        store.log(record, probed)
    return probed.get("psnr")


def _peaks(before: Progress, scene: Scene) -> dict[str, Any]:
    """Return the peak memory of training in this process and in those `before`; scoring has networks of its own."""
    now = clock.peak_memory(scene.points.device)
    return {of: max(filter(None, (peak, getattr(before, of))), default=None) for of, peak in now.items()}


def _trained(method: Method, progress: Progress) -> dict[str, Any]:
    size = method.size()
    initial = {"start": method.start} if "gaussians" in size.counts else {}
    return {
        "status": "ok" if progress.share == 1 else "timeout",
        "iterations_done": progress.iteration,
        "counts": {**size.counts, "parameters": size.parameters, **initial},
        "model_bytes": size.bytes,
        "ended": method.ended,
        "timing": {"train_seconds": progress.seconds, "cpu_seconds": progress.cpu_seconds},
    }


def judge(result: Result, scene: Scene, iterations: int) -> Result:
    """Return the result as diverged (worse than one colour), or under stress as degenerate (depth, thickness)."""
    if not result.ok:
        return result
    metrics: dict[str, float | None] = {}
    is_stressed = result.config.get("stress", {}).get("condition")  # others are in tables whatever they are scored for
    for scores in result.scores.values():
        metrics |= scores.metrics if is_stressed else {}
        known = {name: of for name, view in scores.views.items() if (of := view.get("ws_psnr")) is not None}
        if not known or iterations < MIN_ITERATIONS:
            continue
        constants = constant_color_quality(scene, Protocol(**scores.protocol))
        compared = [name for name in constants if name in known]
        quality, constant = (sum(of[name] for name in compared) / max(1, len(compared)) for of in (known, constants))
        if quality < constant:
            reason = f"WS-PSNR {quality:.2f} dB, and one colour for all would have {constant:.2f} dB"
            return replace(result, status="diverged", reason=reason)
    depth, thickness, reason = metrics.get("depth_error"), metrics.get("least_extent"), ""
    if depth is not None and depth > MAX_DEPTH_ERROR:
        reason = f"depths are off by {depth:.0%} on average (AbsRel), more than {MAX_DEPTH_ERROR:.0%}"
    elif thickness is not None and thickness < MIN_THICKNESS:
        reason = f"surfaces are {thickness:.2%} as thick as the true ones, less than {MIN_THICKNESS:.0%}"
    return replace(result, status="degenerate", reason=reason) if reason else result


def _is_retried(config: RunConfig, result: Result) -> bool:
    return result.status in RETRIED and config.retry == "failed"


def _unscored(config: RunConfig, scene: Scene, result: Result, *, can_score: bool) -> dict[str, Protocol]:
    """Return the protocols under whose rules a run that did not fail has no scores of its test views, if any.

    LPIPS whose weights have come since is missing only where a checkpoint is left to score (`can_score`).
    """
    asked = config.protocols.items() if result.status not in RETRIED and scene.test else ()
    known = {name: scores.protocol for name, scores in result.scores.items()}
    late = {name for name, of in result.scores.items() if can_score and NO_WEIGHTS in "".join(of.notes)}
    return {
        name: rules
        for name, rules in asked
        if name not in known or not _covers(known[name], _stored(rules)) or (name in late and has_weights(rules.lpips))
    }


def _stored(rules: Protocol) -> dict[str, Any]:
    return json.loads(json.dumps(asdict(rules)))


def _covers(rules: Mapping[str, Any], others: Mapping[str, Any]) -> bool:
    """Return whether scores under rules have all that others ask for: they are the same, but may have LPIPS besides."""
    lpips = ("lpips", "lpips_inputs") if others.get("lpips") == "none" else ()
    return {**rules, **{key: others.get(key) for key in lpips}} == others


def _refuse_other_rules(store: RunStore, result: Result, unscored: Mapping[str, Protocol]) -> None:
    """Refuse to replace scores by those under other rules of the same name, which an experiment may be about."""
    for name, asked in ((name, _stored(rules)) for name, rules in unscored.items() if name in result.scores):
        rules = result.scores[name].protocol
        if not _covers(asked, rules):
            others = ", ".join(f"{key}={rules.get(key)}, not {of}" for key, of in asked.items() if rules.get(key) != of)
            raise RunFolderError(
                f"{store.path} has scores of {name} under other rules ({others}), and a run has scores of one; "
                "set run.folder to another folder"
            )


def _completed(config: RunConfig, scene: Scene, store: RunStore, console: Console) -> Result | None:
    """Return the result of a finished run with all scores and experiments; None if the run is to be trained."""
    result = store.result()  # another process may have finished it in the meantime
    if result is None or _is_retried(config, result):
        if result is not None:
            store.forget(result)
        return None
    complete = replace(result, experiments=results.joined(result.experiments, config.labels.experiments))
    if unscored := _unscored(config, scene, result, can_score=store.has_checkpoint):
        _refuse_other_rules(store, result, unscored)
        say(console, "finished before; only scores are missing")
        if not store.has_checkpoint:  # an untrained method would be scored
            raise RunFolderError(
                f"{store.path} has a result but no checkpoint any more, so it cannot be scored under other "
                f"rules of {', '.join(unscored)}; keep the old rules, or delete the folder to train again"
            )
        method = build_method(config)
        store.resume(method, scene.points.device)
        scores = {**result.scores, **score(method.render, scene, unscored, None, calibrates=method.calibrates)}
        complete = judge(replace(complete, scores=scores), scene, result.iterations_done)
    return result if complete == result else store.finish(complete)
