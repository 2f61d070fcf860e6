"""The result of a run that has just begun, and the status of what may end it."""

from __future__ import annotations

from dataclasses import replace

from padgs import clock
from padgs.baselines import distribution
from padgs.evaluation.protocols import Protocol
from padgs.results import STATUSES, Result
from padgs.runs.config import RunConfig
from padgs.runs.identity import config_hash
from padgs.runs.scoring import quality_of_one_color
from padgs.scene import Scene
from padgs.training.failure import Failure, is_out_of_memory, memory_reason

WRONG_DEPTH = 0.5  # AbsRel
FLAT = 0.01  # of the true thickness of all surfaces together, along the axis where they are thinnest
SOON = 50  # iterations; before that a run may simply not have got anywhere yet
RETRIED = STATUSES.keys() - {"ok", "timeout"}  # by retry=failed; with more train.max_seconds it would be another run


def begun(config: RunConfig, scene: Scene, run: str) -> Result:
    """What is known before the first iteration; status ok, as long as nothing says otherwise."""
    view = (scene.test or scene.train)[0]
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
        finished="",
        config=values,
        experiments=config.labels.experiments,
    )


def status(error: Exception) -> str:
    """The status of a run that this ended; an error of ours is none, and raised again."""
    if isinstance(error, Failure):
        return error.status
    if isinstance(error, ValueError):
        return "rejected"
    if is_out_of_memory(error):
        return "oom"
    raise error


def reason(error: Exception) -> str:
    """Why a run failed, in words."""
    return str(error) if isinstance(error, (Failure, ValueError)) else f"out of memory: {memory_reason(error)}"


def judged(result: Result, scene: Scene, iterations: int) -> Result:
    """The result with its status, now that test views of the scene were scored after so many iterations."""
    if not result.ok:
        return result
    marks: dict[str, float | None] = {}
    for scores in result.scores.values():
        marks |= scores.metrics
        quality = scores.metrics.get("ws_psnr")
        if quality is None or iterations < SOON:
            continue
        if quality < (one_color := quality_of_one_color(scene, Protocol(**scores.protocol))):
            reason = f"WS-PSNR {quality:.2f} dB, and one colour for all would have {one_color:.2f} dB"
            return replace(result, status="diverged", reason=reason)
    depth, extent = marks.get("depth_error"), marks.get("least_extent")
    if depth is not None and depth > WRONG_DEPTH:
        reason = f"depths are off by {depth:.0%} on average (AbsRel), more than {WRONG_DEPTH:.0%}"
        return replace(result, status="degenerate", reason=reason)
    if extent is not None and extent < FLAT:
        reason = f"surfaces are {extent:.2%} as thick as the true ones along some axis, less than {FLAT:.0%}"
        return replace(result, status="degenerate", reason=reason)
    return result


def peak_memory(scene: Scene) -> dict[str, int | None]:
    """The fields of a result about the memory that was used so far, where the scene is."""
    peak = clock.peak_memory(scene.points.device)
    return {"peak_memory_bytes": peak["host"], "peak_device_memory_bytes": peak["device"]}
