"""What a search says: the need for each loss, the knee and the front, and the pruned model as a run of its own."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from padgs.learning.trainee import MODEL, State
from padgs.need.calibration import PERCEPTION, QUALITY
from padgs.need.search import EPSILONS, against, knee, loss, smallest
from padgs.need.session import Search
from padgs.results import Result
from padgs.runs.folder import PROGRESS, Progress, RunFolder
from padgs.runs.identity import config_hash, identity
from padgs.runs.scoring import frame_times, scores

ADAM = "adam/"  # moments of the run's own rows, which a pruned model does not have
EXPERIMENT = "need"


def need(search: Search) -> dict[str, Any]:
    """What a finished search found, as JSON can hold it, for `Result.need`.

    Returns:
        row: gaussians or anchors; rows: of the run's own model; waste: of them shown nowhere; needs: epsilon -> number
        of the smallest step; knee: number of a step, or None; steps: from the first to the last, with what each lost
        against its control, and what stands against it at each epsilon; calibration: names of views; seconds,
        cpu_seconds: of all steps.
    """
    steps, told = search.steps, []
    for number, step in enumerate(steps):
        numbers = {name: value for name, value in asdict(step).items() if name not in ("marks", "test")}
        numbers |= {"loss": loss(steps, number), "ws_psnr": step.marks.metrics[QUALITY]}
        numbers |= {"lpips": step.marks.metrics.get(str(PERCEPTION)), "test_ws_psnr": step.test.get(QUALITY)}
        numbers["objections"] = {f"{epsilon:g}": list(against(steps, number, epsilon)) for epsilon in EPSILONS}
        told.append(numbers)
    return {
        "row": search.row,
        "rows": search.rows,
        "waste": search.rows - steps[0].rows,
        "needs": {f"{epsilon:g}": smallest(steps, epsilon) for epsilon in EPSILONS},
        "knee": knee(steps),
        "steps": told,
        "calibration": [view.name for view in search.calibration],
        "seconds": math.fsum(step.seconds for step in steps),
        "cpu_seconds": math.fsum(step.cpu_seconds for step in steps),
    }


def write_pruned(search: Search, epsilon: float) -> Path:
    """Write the smallest model that loses at most epsilon as a run beside the searched one; returns its folder.

    It has seen the calibration views again. Its training time is that of the run and of the search; its protocols are
    the run's.

    Raises:
        RunFolderError, CheckpointError: it cannot be written.
        RunBusy: another process writes it.
    """
    run, number = search.run, smallest(search.steps, epsilon)
    assert run.result is not None, "only of a finished run"
    variant = ", ".join(filter(None, (run.config.variant, f"need {epsilon:g} dB")))
    values = {**run.result.config, "variant": variant}
    path = run.folder.with_name(f"{run.folder.name}_need-{epsilon:g}")
    folder = RunFolder(path, identity(values, run.result.fingerprint))
    trained, model = run.method.state(), search.kept(number)
    of_model = model.state()
    kept = {n: t for n, t in trained.tensors.items() if not n.startswith((MODEL, ADAM))}
    tensors = kept | {f"{MODEL}{name}": tensor for name, tensor in of_model.tensors.items()}
    run.method.load_state(State(tensors, {**trained.values, "model": of_model.values}))
    size, found = model.size(), need(search)
    with folder.locked():
        folder.prepare(values)
        folder.save(run.method, Progress(**trained.values[PROGRESS]))
        scene, timing = run.scene, dict(run.result.timing)
        for name in {"train_seconds", "cpu_seconds"} & timing.keys():
            timing[name] += found[name.removeprefix("train_")]
        tested = {}
        if scene.test:
            timing |= frame_times(run.method, scene)
            tested = {"scores": scores(run.method, scene, run.config.protocols, folder.save_picture)}
        start = {name: run.result.counts[name] for name in ("start",) if name in run.result.counts}
        made: Result = replace(
            run.result,
            run=folder.path.name,
            variant=variant,
            counts={**size.counts, "parameters": size.parameters, **start},
            model_bytes=size.bytes,
            timing=timing,
            config=values,
            config_hash=config_hash(values),
            experiments=(EXPERIMENT,),
            finished=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            need=found,
            **tested,
        )
        folder.finish(made)
    run.method.load_state(trained)
    return folder.path
