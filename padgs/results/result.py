"""What a run has to say for itself: what was trained, how it ended, and its marks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

STATUSES = {
    "ok": "trained to the end and evaluated",
    "oom": "an allocation failed, or memory would have passed the declared limit",
    "nan": "a loss, gradient or parameter was not finite",
    "diverged": "the loss rose far above its best and stayed there, or test views are worse than one mean colour",
    "collapsed": "next to nothing was left to draw",
    "exploded": "Gaussians grew far beyond the scene, or in number beyond all pixels",
    "degenerate": "pictures may be fine, but the depth behind them is wrong",
    "silent": "nothing pulled at some of the parameters",
    "timeout": "the time limit came before the last iteration",
    "rejected": "the input was refused with a clear error",
}
STOP_REQUESTED = (
    "asked to stop and score"  # why a run ended, where no setting says so: it is no seed of one that ran on
)
AD_HOC = "ad_hoc"  # among experiments: a command without any requested the run as well
HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False}  # of every metric with the word in it
SMALLEST_LOSSES = (0.05, 0.1, 0.25, 0.5, 1.0)  # dB, for each of which `padgs smallest` finds the smallest model
SMALLEST_STATED = 0.1  # of these, the one that is put into one number, and whose model is kept if no other is asked for
SMALLEST_PICTURED = (SMALLEST_STATED, 1.0)


@dataclass(frozen=True)
class Scores:
    """The marks of one run under one protocol. Numbers of different protocols cannot be compared."""

    protocol: dict[str, Any]  # all its rules
    metrics: dict[str, float | None]  # metric -> mean over the test views; None = missing
    views: dict[str, dict[str, float | None]]  # view -> metric -> value
    notes: tuple[str, ...] = ()  # what is missing and why


@dataclass(frozen=True)
class Result:
    """One finished run. Times are in seconds unless the name says ms; memory in bytes."""

    run: str  # run id = name of the run folder
    status: str  # key of STATUSES
    method: str  # name in `baselines.METHODS`
    preset: str  # what `method=` was when the run was started: a method, or a file in conf/method
    variant: str  # row of an ablation; empty for none
    dataset: str  # synthetic, a name of padgs.data.DATASETS, or empty for a capture of one's own
    scene: str
    width: int  # of the test views, pixels
    height: int
    iterations: int  # asked for; those that were done, where seconds were asked for
    iterations_done: int
    seed: int
    code_version: str
    machine: dict[str, Any]  # as `padgs.clock.machine` describes it
    config_hash: str
    fingerprint: str  # of the data
    finished: str  # UTC, ISO 8601
    reason: str = ""  # why a run failed
    ended: str = ""  # why a run that ended well left out a part of its schedule, see `padgs.training.health`
    scores: dict[str, Scores] = field(default_factory=dict)  # protocol -> marks
    timing: dict[str, float] = field(default_factory=dict)  # train_seconds, render_ms_median, render_ms_p95, ...
    counts: dict[str, int] = field(default_factory=dict)  # anchors, gaussians, ...
    model_bytes: int = 0
    peak_memory_bytes: int = 0  # of the process, while training
    peak_device_memory_bytes: int | None = None  # of torch's tensors on the GPU, while training; None on the CPU
    config: dict[str, Any] = field(default_factory=dict)  # the resolved configuration
    experiments: tuple[str, ...] = ()  # experiments and sweeps that it belongs to, sorted; see `joined`
    smallest: dict[str, Any] = field(default_factory=dict)  # of the kept model: see `padgs.runs.smallest.Search.front`

    def __post_init__(self) -> None:
        """Reject a status that no table knows."""
        if self.status not in STATUSES:
            raise ValueError(f"unknown status {self.status!r}; known: {', '.join(STATUSES)}")

    @property
    def ok(self) -> bool:
        """Whether the scores count."""
        return self.status == "ok"


def joined(first: Iterable[str], second: Iterable[str]) -> tuple[str, ...]:
    """The experiments of a run that two commands asked for; none of a run that was asked for by itself alone.

    >>> joined(("tau",), ("table1",)), joined((), ("tau",)), joined((), ())
    (('table1', 'tau'), ("ad_hoc", "tau"), ())
    """
    names = {*(tuple(first) or (AD_HOC,)), *(tuple(second) or (AD_HOC,))}
    return () if names == {AD_HOC} else tuple(sorted(names))


def higher_is_better(metric: str) -> bool | None:
    """Which end of a metric is the better one, by the word of `HIGHER_IS_BETTER` in its name; None for others.

    >>> higher_is_better("ws_psnr_pole"), higher_is_better("lpips_vgg_01"), higher_is_better("seam")  # best at 1
    (True, False, None)
    """
    return next((HIGHER_IS_BETTER[word] for word in metric.split("_") if word in HIGHER_IS_BETTER), None)


# Keys that no trained number depends on but by rounding: of the machine, and the others. What was
# read is said by the fingerprint of the data; scoring comes after training; a monitor changes no number, but may end a
# run. `data.device` is in files of old runs only.
OF_THE_MACHINE = ("run", "render.max_instances", "data.cache_bytes", "data.prefetch_threads")
DECIDE_NOTHING = (*OF_THE_MACHINE, "data.path", "init.run", "protocol", "train.monitor")


def decisive(config: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """A configuration without the keys that decide nothing.

    >>> decisive({"seed": 0, "run": {"threads": 2}, "data": {"path": "/x", "width": 64}})
    {'seed': 0, 'data': {'width': 64}}
    """
    return {
        key: decisive(value, f"{where}{key}.") if isinstance(value, Mapping) else value
        for key, value in config.items()
        if f"{where}{key}" not in DECIDE_NOTHING
    }
