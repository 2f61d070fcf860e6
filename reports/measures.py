"""Numbers of runs that reports compare, with their columns and the paper's names for them."""

from dataclasses import dataclass, replace

from pandas import DataFrame

from padgs.reports import published
from padgs.reports.table import Column, ReportError
from padgs.results import higher_is_better

PAPER_METRICS = ("ssim", "psnr", "lpips")  # in the order of the paper's tables
PROTOCOL_METRICS = {  # protocol -> its counterpart of each of PAPER_METRICS
    "paper": {"ssim": "ssim", "psnr": "psnr", "lpips": "lpips_vgg_01"},
    "sphere": {"ssim": "ws_ssim", "psnr": "ws_psnr", "lpips": "ws_lpips_alex"},
}
TITLES = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "ws": "WS", "vgg": "VGG", "alex": "Alex", "01": "[0, 1]"}

DEPTH = {"abs_rel": Column("depth AbsRel", 3, False), "delta_1_25": Column("depth δ < 1.25", 3, True)}


@dataclass(frozen=True)
class Measure:
    """A number of a run; `published` is the metric of `baselines/published.csv` that it may stand beside."""

    name: str  # of its column in the frame
    column: Column
    published: str | None = None
    difference: bool = False  # whether ours minus the paper's means anything


_COSTS = (
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
    Measure("minimal_count", Column("minimal count", 0, False)),
    Measure("megabytes", Column("model MB", 1, False)),
    Measure("polar_transmittance", Column("transmittance above 85°", 3, False)),
    Measure("peak_gigabytes", Column("peak GB", 2, False)),
    Measure("peak_gpu_gigabytes", Column("peak GPU GB", 2, False)),
)
COSTS = {measure.name: measure for measure in _COSTS}


def metric(protocol: str, name: str, group: str = "") -> Measure:
    """Return a metric under a protocol.

    >>> metric("sphere", "ws_psnr_pole").column.heading, metric("paper", "lpips_vgg_01").column.heading
    ('WS-PSNR pole ↑', 'LPIPS VGG [0, 1] ↓')
    """
    title = " ".join(TITLES.get(word, word) for word in name.split("_")).replace("WS ", "WS-")
    column = DEPTH.get(name) or Column(title, 2 if "psnr" in name else 3, higher_is_better(name))
    return Measure(f"{protocol}/{name}", replace(column, group=group))


def metrics(protocol: str) -> tuple[Measure, ...]:
    """Return SSIM, PSNR and LPIPS of a protocol, or their counterparts; a ReportError lists the known protocols."""
    if protocol not in PROTOCOL_METRICS:
        raise ReportError(f"unknown protocol {protocol!r}; known: {', '.join(PROTOCOL_METRICS)}")
    ours = {name: metric(protocol, PROTOCOL_METRICS[protocol][name], name.upper()) for name in PAPER_METRICS}
    if protocol != published.PROTOCOL:
        return tuple(ours.values())
    return tuple(replace(measure, published=name, difference=True) for name, measure in ours.items())


def quantity(name: str, protocol: str, runs: DataFrame) -> Measure:
    """Return a metric that runs have under a protocol, or a cost, by its name; a ReportError lists the known ones."""
    known = [column.removeprefix(f"{protocol}/") for column in runs if column.startswith(f"{protocol}/")]
    if name not in (*known, *COSTS):
        raise ReportError(f"unknown metric {name!r}; known under protocol {protocol}: {', '.join((*known, *COSTS))}")
    return COSTS[name] if name in COSTS else metric(protocol, name)
