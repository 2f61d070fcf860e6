"""What is compared between methods: a number of each run, how it is read, and what the paper calls it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from pandas import DataFrame

from padgs.reports import published
from padgs.reports.tables.table import Column, ReportError
from padgs.results import higher_is_better

PAPER_METRICS = ("ssim", "psnr", "lpips")  # the order of the paper's tables
PROTOCOL_METRICS = {  # protocol -> the metric that stands for each of PAPER_METRICS
    "paper": {"ssim": "ssim", "psnr": "psnr", "lpips": "lpips_vgg_01"},
    "sphere": {"ssim": "ws_ssim", "psnr": "ws_psnr", "lpips": "ws_lpips_alex"},
}
TITLES = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "ws": "WS", "vgg": "VGG", "alex": "Alex", "01": "[0, 1]"}


@dataclass(frozen=True)
class Measure:
    """A number of a run; `published` is the metric of `baselines/published.csv` that it may stand beside."""

    name: str  # of its column in the frame
    column: Column
    published: str | None = None
    difference: bool = False  # whether ours minus the paper's means anything


COSTS = {
    measure.name: measure
    for measure in (
        Measure("iterations_done", Column("iterations", 0)),
        Measure("images", Column("images seen", 0)),
        Measure("train_hours", Column("training h", 4, False, group="training h"), "train_hours"),
        Measure("train_seconds", Column("training s", 0, False)),
        Measure("cpu_seconds", Column("CPU s", 0, False)),
        Measure("fps", Column("FPS", 2, True, group="FPS"), "fps"),
        Measure("frame_ms", Column("ms per frame", 1, False)),
        Measure("anchors", Column("anchors", 0)),
        Measure("start", Column("started from", 0)),
        Measure("gaussians", Column("Gaussians", 0)),
        Measure("megabytes", Column("model MB", 1, False)),
        Measure("polar_transmittance", Column("transmittance above 85°", 3, False)),
        Measure("peak_gigabytes", Column("peak GB", 2, False)),
        Measure("peak_gpu_gigabytes", Column("peak GPU GB", 2, False)),
    )
}


def costs(*names: str, **how: Any) -> tuple[Measure, ...]:
    """Some of `COSTS`; `how` says what is different about their columns."""
    return tuple(replace(COSTS[name], column=replace(COSTS[name].column, **how)) for name in names)


def known_costs(runs: DataFrame, *names: str, **how: Any) -> tuple[Measure, ...]:
    """Those of some of `COSTS` that are known of any of the runs; tables of the others have no column for them."""
    return costs(*(name for name in names if name in runs and runs[name].notna().any()), **how)


def gpu_memory(runs: DataFrame, **how: Any) -> tuple[Measure, ...]:
    """The memory of the GPU, if it is known of any of the runs."""
    return known_costs(runs, "peak_gpu_gigabytes", **how)


def alone(measure: Measure) -> Measure:
    """The measure with nothing of the paper beside it."""
    return replace(measure, published=None, difference=False)


def mark(protocol: str, metric: str, group: str = "") -> Measure:
    """A metric under a protocol.

    >>> mark("sphere", "ws_psnr_pole").column.heading, mark("paper", "lpips_vgg_01").column.heading
    ('WS-PSNR pole ↑', 'LPIPS VGG [0, 1] ↓')
    """
    title = " ".join(TITLES.get(word, word) for word in metric.split("_")).replace("WS ", "WS-")
    column = Column(title, 2 if "psnr" in metric else 3, higher_is_better(metric), group=group)
    return Measure(f"{protocol}/{metric}", column)


def marks(protocol: str) -> tuple[Measure, ...]:
    """SSIM, PSNR and LPIPS of a protocol, or what stands for them there.

    Raises:
        ReportError: no such protocol; the message lists the known ones.
    """
    if protocol not in PROTOCOL_METRICS:
        raise ReportError(f"unknown protocol {protocol!r}; known: {', '.join(PROTOCOL_METRICS)}")
    ours = {name: mark(protocol, PROTOCOL_METRICS[protocol][name], name.upper()) for name in PAPER_METRICS}
    if protocol != published.PROTOCOL:
        return tuple(ours.values())
    return tuple(replace(measure, published=name, difference=True) for name, measure in ours.items())


def quantity(name: str, protocol: str, runs: DataFrame) -> Measure:
    """A metric that runs have under a protocol, or a cost, by its name.

    Raises:
        ReportError: no such name; the message lists the known ones.
    """
    known = [column.removeprefix(f"{protocol}/") for column in runs if column.startswith(f"{protocol}/")]
    if name not in (*known, *COSTS):
        names = ", ".join((*known, *COSTS))
        raise ReportError(f"unknown metric {name!r}; known under protocol {protocol}: {names}")
    return COSTS[name] if name in COSTS else mark(protocol, name)
