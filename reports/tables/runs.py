"""All runs, one line each: marks under both protocols, latitude bands, and what the model cost.

No number stands out and no column has a better end: the lead of a single run may be its seed or its machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from padgs.results import Result
from reports.measures import on_gpu, peak_gpu_gigabytes
from reports.metrics import column
from reports.published import scene_title
from reports.request import Request, admitted
from reports.tables.cells import over_seeds
from reports.tables.footnotes import conditions
from reports.tables.table import Block, Column, Row, Table

Number = Callable[[Result], "float | None"]

FLAT = ("psnr", "ssim", "lpips_vgg_01")
SPHERE = ("ws_psnr", "ws_ssim", "ws_lpips_alex", *(f"ws_psnr_{band}" for band in ("equator", "middle", "high", "pole")))


def build(results: Sequence[Result], request: Request) -> Table:
    """A block per scene and resolution, a row per run."""
    chosen = admitted(results, request)
    costs = {**COSTS, **GPU_MEMORY} if on_gpu(chosen) else COSTS
    columns = {**_marks("paper", FLAT), **_marks("sphere", SPHERE), **costs}
    places = dict.fromkeys((r.dataset, r.scene, r.width, r.height, r.iterations) for r in chosen)
    blocks, runs_of = [], {}
    for place in places:
        dataset, scene, width, height, iterations = place
        title = f"{scene_title(dataset, scene)}, {width}x{height}, {iterations} iterations"
        own = [r for r in chosen if (r.dataset, r.scene, r.width, r.height, r.iterations) == place]
        rows = [Row(_title(r), tuple(over_seeds([r], number) for number in columns.values())) for r in own]
        blocks.append(Block(title, tuple(rows)))
        runs_of[title] = own
    notes = [note for protocol in ("paper", "sphere") for note in conditions(runs_of, protocol)]
    return Table("runs", "Runs", "Run", tuple(columns), tuple(blocks), tuple(notes))


def _title(result: Result) -> str:
    words = [result.preset, result.variant, f"seed {result.seed}", result.run.rpartition("_")[2]]
    return ", ".join(word for word in words if word)


def _marks(protocol: str, metrics: Sequence[str]) -> dict[Column, Number]:
    def number(metric: str) -> Number:
        return lambda result: result.scores[protocol].metrics.get(metric) if protocol in result.scores else None

    return {replace(column(metric, group=protocol), higher_is_better=None): number(metric) for metric in metrics}


COSTS: dict[Column, Number] = {
    Column("anchors", 0, group="cost"): lambda r: r.counts.get("anchors"),
    Column("Gaussians", 0, group="cost"): lambda r: r.counts.get("gaussians"),
    Column("MB", 1, group="cost"): lambda r: r.model_bytes / 1e6,
    Column("training s", 0, group="cost"): lambda r: r.timing.get("train_seconds"),
    Column("ms per frame", 1, group="cost"): lambda r: r.timing.get("render_ms_median"),
    Column("peak GB", 2, group="cost"): lambda r: r.peak_memory_bytes / 1e9,
}
GPU_MEMORY: dict[Column, Number] = {Column("peak GPU GB", 2, group="cost"): peak_gpu_gigabytes}
