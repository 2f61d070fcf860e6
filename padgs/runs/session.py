"""One run from its configuration to its result: load, train or resume, score, write; skip what is done."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import torch
from rich.console import Console

from baselines import METHODS
from padgs import clock, data
from padgs.learning.failure import Failure, is_out_of_memory
from padgs.learning.method import Method
from padgs.registry import lookup
from padgs.results import Result
from padgs.runs import checkpoint
from padgs.runs.config import RunConfig
from padgs.runs.device import chosen
from padgs.runs.folder import RunFolder, RunFolderError
from padgs.runs.identity import config_hash, run_id
from padgs.runs.interrupt import Interrupted
from padgs.runs.scoring import frame_times, same_rules, scores
from padgs.runs.summary import show_result
from padgs.runs.training import resume, train
from padgs.scene import Scene
from padgs.tracking.watch import Watch


def run(config: RunConfig, console: Console, watch: Watch = Watch()) -> Result:  # noqa: B008 - has no state
    """Do what is missing of a run and show its result.

    Raises:
        DataError: the input cannot be used.
        ResultError, CheckpointError, RunFolderError: files of the run cannot be read or written.
        RunBusy: another process works on this run.
        Interrupted: stopped from outside; starting again goes on.
    """
    if config.run.threads_per_job is not None:
        torch.set_num_threads(config.run.threads_per_job)
    torch.manual_seed(config.seed)
    device = chosen(config.run.device, config.render)
    clock.reset_peak_memory(device)
    options = replace(config.data, device=config.data.device or str(device))
    scene = data.load(config.data.path, config.data.format, options).to(device)
    name = run_id(config.values(), scene.name, scene.fingerprint, config.preset)
    folder = RunFolder(Path(config.run.folder) / name)
    watch.started(folder.path, config.train.iterations)
    _introduce(config, scene, folder, console)
    result = folder.result()
    if result is None or _is_missing(result, config):
        with folder.locked():
            result = _complete(folder.result(), config, scene, folder, console, watch)
    else:
        advice = "" if result.ok else "; it failed, retry=failed starts it again"
        console.print(f"finished before, nothing to do{advice}", highlight=False, soft_wrap=True)
    show_result(result, folder.path, console)
    return result


def _complete(
    result: Result | None, config: RunConfig, scene: Scene, folder: RunFolder, console: Console, watch: Watch
) -> Result:
    """What is missing of a run whose folder is locked; `result` is what is there."""
    if result is not None and not result.ok and config.retry == "failed":
        folder.forget(result)
        result = None
    if result is None:
        folder.prepare(config.values())
        return _finish(config, scene, folder, console, watch)
    if result.ok and not _is_scored(result, config):
        console.print("finished before; only the new protocol is missing")
        result = _score_again(result, config, scene, folder)
    experiments = tuple(sorted({*result.experiments, *config.labels.experiments}))  # a run may serve several tables
    return result if experiments == result.experiments else folder.finish(replace(result, experiments=experiments))


def _is_missing(result: Result, config: RunConfig) -> bool:
    """Whether there is anything left to do about a finished run."""
    if not result.ok and config.retry == "failed":
        return True
    return result.ok and not _is_scored(result, config) or not {*config.labels.experiments} <= {*result.experiments}


def _finish(config: RunConfig, scene: Scene, folder: RunFolder, console: Console, watch: Watch) -> Result:
    method = build(config)
    progress = resume(method, folder, scene.points.device)
    if progress.iteration:
        console.print(f"resuming after iteration {progress.iteration}", highlight=False)
    result = _blank(config, scene, folder)
    try:
        progress = train(method, scene, config, folder, progress, console, watch)
        size = method.size()
        result = replace(
            result,
            status="ok" if progress.iteration == config.train.iterations else "timeout",
            counts={**size.counts, "parameters": size.parameters},
            model_bytes=size.bytes,
            **_peak_memory(scene),  # of training; scoring has networks of its own
        )
        if scene.test:
            save_picture = folder.save_picture if config.run.pictures else None
            timing = {"train_seconds": progress.seconds, **frame_times(method, scene)}
            result = replace(result, scores=scores(method, scene, config.protocols, save_picture), timing=timing)
    except Interrupted:
        raise
    except KeyboardInterrupt as error:
        raise Interrupted("stopped at once, the last checkpoint stands") from error
    except (Failure, ValueError, MemoryError, RuntimeError) as error:
        result = replace(result, status=_status(error), reason=str(error), scores={}, **_peak_memory(scene))
    result = replace(
        result,
        iterations_done=progress.iteration,
        finished=datetime.now(timezone.utc).isoformat(timespec="seconds"),
    )
    return folder.finish(result)


def build(config: RunConfig) -> Method:
    """The method of a configuration, untrained."""
    return lookup(METHODS, config.method, "method")(config.options, config.render, config.train, seed=config.seed)


def _score_again(result: Result, config: RunConfig, scene: Scene, folder: RunFolder) -> Result:
    missing = {
        name: protocol
        for name, protocol in config.protocols.items()
        if name not in result.scores or not same_rules(result.scores[name], protocol)
    }
    if not checkpoint.exists(folder.checkpoint):  # an untrained method would be scored
        raise RunFolderError(
            f"{folder.path} has a result but no checkpoint any more, so it cannot be scored under other rules of "
            f"{', '.join(missing)}; keep the old rules, or delete the folder to train again"
        )
    method = build(config)
    resume(method, folder, scene.points.device)
    result = replace(result, scores={**result.scores, **scores(method, scene, missing, None)})
    return folder.finish(result)


def _is_scored(result: Result, config: RunConfig) -> bool:
    return all(
        name in result.scores and same_rules(result.scores[name], protocol)
        for name, protocol in config.protocols.items()
    )


def _peak_memory(scene: Scene) -> dict[str, int | None]:
    peak = clock.peak_memory(scene.points.device)
    return {"peak_memory_bytes": peak["host"], "peak_device_memory_bytes": peak["device"]}


def _status(error: BaseException) -> str:
    if isinstance(error, Failure):
        return error.status
    if isinstance(error, ValueError):
        return "rejected"
    if is_out_of_memory(error):
        return "oom"
    raise error


def _blank(config: RunConfig, scene: Scene, folder: RunFolder) -> Result:
    view = (scene.test or scene.train)[0]
    machine = clock.machine(scene.points.device)
    values = config.values()
    return Result(
        run=folder.path.name,
        status="ok",
        method=config.method,
        preset=config.preset,
        variant=config.variant,
        dataset=config.data.dataset or ("" if config.data.path else "synthetic"),
        scene=scene.name,
        width=view.width,
        height=view.height,
        iterations=config.train.iterations,
        iterations_done=0,
        seed=config.seed,
        code_version=" ".join(part for part in (machine["padgs"], (machine["commit"] or "")[:10]) if part) or "unknown",
        machine=machine,
        config_hash=config_hash(values),
        fingerprint=scene.fingerprint,
        finished="",
        config=values,
        experiments=config.labels.experiments,
    )


def _introduce(config: RunConfig, scene: Scene, folder: RunFolder, console: Console) -> None:
    view = scene.train[0]
    what = f"{config.preset}{f' ({config.variant})' if config.variant else ''} on {scene.name}"
    views = f"{len(scene.train)} training and {len(scene.test)} test views of {view.width}x{view.height}"
    console.print(
        f"[bold]{what}[/]: {views}, {len(scene.points)} points, {config.train.iterations} iterations",
        highlight=False,
        soft_wrap=True,
    )
    for note in scene.notes:
        console.print(f"  {note}", style="dim", highlight=False, soft_wrap=True)
    console.print(f"  {folder.path}", style="dim", highlight=False, soft_wrap=True)
