"""All runs, one line each: marks under both protocols, latitude bands, and what the model cost.

No number stands out and no column has a better end: the lead of a single run may be its seed or its machine.
"""

from __future__ import annotations

from dataclasses import replace

from padgs.reports.conditions import footnotes
from padgs.reports.frame import grouped
from padgs.reports.gathered import Gathered
from padgs.reports.measures import costs, gpu_memory, mark
from padgs.reports.published import scene_title
from padgs.reports.settings import Setting, settings
from padgs.reports.tables.cells import over_seeds
from padgs.reports.tables.table import Block, Row, Table

MARKS = {
    "paper": ("psnr", "ssim", "lpips_vgg_01"),
    "sphere": ("ws_psnr", "ws_ssim", "ws_lpips_alex", *(f"ws_psnr_{b}" for b in ("equator", "middle", "high", "pole"))),
}
AMONG_COSTS = {"group": "cost", "higher_is_better": None}
COSTS = (
    *costs("anchors", "gaussians", **AMONG_COSTS),
    *costs("megabytes", title="MB", **AMONG_COSTS),
    *costs("train_seconds", "frame_ms", "peak_gigabytes", **AMONG_COSTS),
)


def runs(gathered: Gathered) -> Table:
    """A block per scene, resolution and length, a row per run, which says in what the settings of a preset differ."""
    found = gathered.asked_for
    measured = [mark(protocol, metric, protocol) for protocol, metrics in MARKS.items() for metric in metrics]
    plain = [replace(measure, column=replace(measure.column, higher_is_better=None)) for measure in measured]
    measures = (*plain, *COSTS, *gpu_memory(found, **AMONG_COSTS))
    blocks, runs_of = [], {}
    for (place, resolution, length), own in grouped(found, "place", "resolution", "length"):
        title = f"{scene_title(place.dataset, place.scene)}, {resolution}, {length}"
        rows = (
            Row(_title(setting, seed, run), tuple(over_seeds(own.loc[[index]], measures)))
            for setting in settings(own)
            for index, seed, run in setting.runs[["seed", "run"]].itertuples()
        )
        blocks.append(Block(title, tuple(rows)))
        runs_of[title] = own
    notes = [note for protocol in MARKS for note in footnotes(runs_of, protocol)]
    return Table("runs", "Runs", "Run", tuple(m.column for m in measures), tuple(blocks), tuple(notes))


def _title(setting: Setting, seed: int, run: str) -> str:
    return ", ".join([setting.preset, *setting.apart, f"seed {seed}", run.rpartition("_")[2]])
