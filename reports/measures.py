"""What is compared between methods: a number of each result, how it is read, and what the paper calls it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from padgs.results import Result
from reports import published
from reports.metrics import PAPER_METRICS, PROTOCOL_METRICS, column
from reports.tables.table import Column, ReportError


@dataclass(frozen=True)
class Measure:
    """A number of a result; `published` is the metric of `baselines/published.csv` that it may stand beside."""

    column: Column
    number: Callable[[Result], float | None]
    published: str | None = None
    difference: bool = False  # whether ours minus the paper's means anything


def marks(protocol: str) -> tuple[Measure, ...]:
    """SSIM, PSNR and LPIPS of a protocol, or what stands for them there.

    Raises:
        ReportError: no such protocol; the message lists the known ones.
    """
    if protocol not in PROTOCOL_METRICS:
        raise ReportError(f"unknown protocol {protocol!r}; known: {', '.join(PROTOCOL_METRICS)}")
    paper = protocol == published.PROTOCOL
    names = PROTOCOL_METRICS[protocol]
    return tuple(
        Measure(column(names[name], name.upper()), mark(protocol, names[name]), name if paper else None, paper)
        for name in PAPER_METRICS
    )


def mark(protocol: str, metric: str) -> Callable[[Result], float | None]:
    """The mark of a result under a protocol; None where it was not scored so."""
    return lambda result: result.scores[protocol].metrics.get(metric) if protocol in result.scores else None


def quantity(name: str, protocol: str, results: Sequence[Result]) -> Measure:
    """A metric that results have under a protocol, or a cost, by its name.

    Raises:
        ReportError: no such name; the message lists the known ones.
    """
    if name in QUANTITIES:
        return QUANTITIES[name]
    scored = [result.scores[protocol].metrics for result in results if protocol in result.scores]
    known = dict.fromkeys(metric for metrics in scored for metric in metrics)
    if name not in known:
        names = ", ".join((*known, *QUANTITIES))
        raise ReportError(f"unknown metric {name!r}; known under protocol {protocol}: {names}")
    return Measure(column(name), mark(protocol, name))


def train_seconds(result: Result) -> float | None:
    """Training time in seconds."""
    return result.timing.get("train_seconds")


def hours(result: Result) -> float | None:
    """Training time in hours."""
    seconds = train_seconds(result)
    return None if seconds is None else seconds / 3600


def frame_ms(result: Result) -> float | None:
    """Median time of a rendered test view in milliseconds, decoding included."""
    return result.timing.get("render_ms_median")


def fps(result: Result) -> float | None:
    """Frames per second at that time."""
    milliseconds = frame_ms(result)
    return 1000 / milliseconds if milliseconds else None


def gaussians(result: Result) -> float | None:
    """Gaussians of the trained model; None for a method without any."""
    return result.counts.get("gaussians")


def megabytes(result: Result) -> float | None:
    """Size of the trained model in MB (10^6 bytes)."""
    return result.model_bytes / 1e6 if result.model_bytes else None


def peak_gigabytes(result: Result) -> float | None:
    """Peak memory of the process while training, in GB (10^9 bytes)."""
    return result.peak_memory_bytes / 1e9 if result.peak_memory_bytes else None


def peak_gpu_gigabytes(result: Result) -> float | None:
    """Peak memory of the tensors on the GPU while training, in GB; None for a run on the CPU."""
    return None if result.peak_device_memory_bytes is None else result.peak_device_memory_bytes / 1e9


def on_gpu(results: Sequence[Result]) -> bool:
    """Whether the memory of a GPU is known of any of them; tables of the others have no column for it."""
    return any(peak_gpu_gigabytes(result) is not None for result in results)


COSTS: Sequence[Measure] = (
    Measure(Column("training h", 4, False, group="training h"), hours, "train_hours"),
    Measure(Column("FPS", 2, True, group="FPS"), fps, "fps"),
    Measure(Column("ms per frame", 1, False), frame_ms),
    Measure(Column("Gaussians", 0), gaussians),
    Measure(Column("model MB", 1, False), megabytes),
    Measure(Column("peak GB", 2, False), peak_gigabytes),
)
GPU_MEMORY = Measure(Column("peak GPU GB", 2, False), peak_gpu_gigabytes)

QUANTITIES = {  # what charts can show beside the metrics
    "frame_ms": Measure(Column("ms per frame", 1, False), frame_ms),
    "train_seconds": Measure(Column("training s", 0, False), train_seconds),
    "gaussians": Measure(Column("Gaussians", 0), gaussians),
    "megabytes": Measure(Column("model MB", 1, False), megabytes),
    "peak_gigabytes": Measure(Column("peak GB", 2, False), peak_gigabytes),
    "peak_gpu_gigabytes": GPU_MEMORY,
}
