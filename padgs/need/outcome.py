"""What a search says: the need for each loss, the knee and the front, and the pruned model as a run of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from padgs.evaluation.images import to_uint8
from padgs.evaluation.scoring import frame_times, score
from padgs.need.calibration import PERCEPTION, QUALITY
from padgs.need.files import files
from padgs.need.plan import Step, against, degrees, knee, loss, smallest
from padgs.need.search import Search
from padgs.results import NEED_LOSSES, NEED_PICTURE, NEED_PICTURED, Result
from padgs.runs.run import build_method
from padgs.runs.store import PROGRESS, Progress, RunStore, config_hash, identity
from padgs.training.model import MODEL, State
from padgs.training.optimizer import ADAM

EXPERIMENT = "need"


def need(search: Search) -> dict[str, Any]:
    """What the steps of a finished search say, as JSON can hold it, for `Result.need`.

    Returns:
        row: gaussians or anchors; rows: of the run's own model; waste: of them shown nowhere; needs: epsilon -> number
        of the smallest step; knee: number of a step, or None; steps: from the first to the last, with what each lost
        against its control, and what stands against it at each epsilon; degrees: epsilon -> the same of the steps that
        took harmonics from the smallest; calibration: names of views; seconds, cpu_seconds: of all steps.
    """
    steps = search.steps
    sizes = [number for number, step in enumerate(steps) if step.kind != "degree"]  # these come first
    needs = {f"{epsilon:g}": smallest(steps, epsilon) for epsilon in NEED_LOSSES}
    return {
        "row": search.row,
        "rows": search.rows,
        "waste": search.rows - steps[0].rows,
        "needs": needs,
        "knee": knee(steps),
        "steps": [_told(steps, number) for number in sizes],
        "degrees": {
            name: [_told(steps, n) for n in made] for name, at in needs.items() if (made := degrees(steps, at))
        },
        "calibration": [view.name for view in search.calibration],
        "seconds": math.fsum(step.seconds for step in steps),
        "cpu_seconds": math.fsum(step.cpu_seconds for step in steps),
    }


def _told(steps: Sequence[Step], number: int) -> dict[str, Any]:
    step = steps[number]
    numbers = {name: value for name, value in asdict(step).items() if name not in ("marks", "test")}
    numbers |= {"loss": loss(steps, number), "ws_psnr": step.marks.metrics[QUALITY]}
    numbers |= {"lpips": step.marks.metrics.get(str(PERCEPTION)), "test_ws_psnr": step.test.get(QUALITY)}
    return numbers | {"objections": {f"{epsilon:g}": list(against(steps, number, epsilon)) for epsilon in NEED_LOSSES}}


def keep(search: Search, epsilon: float) -> Result:
    """Make all steps, and keep what is needed for losing at most epsilon dB as a run beside the searched one.

    That is the smallest model with as few harmonics as it takes, refined once more on all training views, and the
    smallest file that it can be kept in. Its training time is that of the run, of the search and of this refinement;
    its protocols are the run's. What was kept of the same step before stays.

    Raises:
        Interrupted, Failure: as `Search.complete` does.
        RunFolderError, CheckpointError: it cannot be written.
        RunBusy: another process writes it.
    """
    number, run = search.complete(epsilon), search.run
    assert run.result is not None, "only of a finished run"
    found, step = need(search), search.steps[number]
    found["kept"] = {"epsilon": epsilon, "degree": step.degree, "loss": loss(search.steps, number)}
    stated = f"need {epsilon:g} dB"
    variant = ", ".join(filter(None, (run.config.variant, stated)))
    values, options = {**run.result.config, "variant": variant}, run.config.options
    if step.degree is not None:
        values["method"] = {**values["method"], "sh_degree": step.degree}
        options = replace(options, sh_degree=step.degree)
    path = run.folder.resolve().with_name(f"{run.result.run}_need-{epsilon:g}")  # whatever its folder is called now
    folder = RunStore(path, identity(values, run.result.fingerprint))
    before = folder.result()
    if before is not None and _is_same(before.need, found):
        return before
    trained, (model, refined) = run.method.state(), search.kept(number)
    of_model, method = model.state(), build_method(replace(run.config, options=options))
    # Adam's moments are those of the rows of the run, not of the pruned model's.
    kept = {n: t for n, t in trained.tensors.items() if not n.startswith((MODEL, ADAM))}
    tensors = kept | {f"{MODEL}{name}": tensor for name, tensor in of_model.tensors.items()}
    method.load_state(State(tensors, {**trained.values, "model": of_model.values}))
    size = model.size()
    with folder:
        folder.prepare(values)
        folder.save(method, Progress(**trained.values[PROGRESS]))
        scene, timing = run.scene, dict(run.result.timing)
        for name, last in zip(("train_seconds", "cpu_seconds"), refined, strict=True):
            if name in timing:
                timing[name] += found[name.removeprefix("train_")] + last
        tested = {}
        if scene.test:
            timing |= frame_times(method.render, scene)
            tested = {"scores": score(method.render, scene, run.config.protocols, folder.save_image)}
            _side_by_side(search, path / NEED_PICTURE)
        start = {name: run.result.counts[name] for name in ("start",) if name in run.result.counts}
        made: Result = replace(
            run.result,
            run=path.name,
            variant=", ".join(filter(None, (run.result.variant, stated))),  # stress, and how it ended, included
            counts={**size.counts, "parameters": size.parameters, **start},
            model_bytes=size.bytes,
            timing=timing,
            config=values,
            config_hash=config_hash(values),
            experiments=(EXPERIMENT,),
            finished=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            need={**found, "files": files(search, model, path, epsilon)},
            **tested,
        )
        return folder.finish(made)


def _is_same(before: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    """Whether a need of before is of the same search, in which the first step took as long, and kept the same step."""
    told = "files" in before and before["kept"] == found["kept"]
    return told and before["steps"][0]["seconds"] == found["steps"][0]["seconds"]


@torch.no_grad()
def _side_by_side(search: Search, path: Path) -> None:
    """The middle test view: its photograph, the run's model, and what is left of that for two losses."""
    view = search.run.scene.test[len(search.run.scene.test) // 2]
    steps = (search.model_of(smallest(search.steps, epsilon)) for epsilon in NEED_PICTURED)
    images = [view.image(), *(model.render(view).image for model in (search.run.method, *steps))]
    Image.fromarray(np.concatenate([to_uint8(image) for image in images], axis=1)).save(path)
