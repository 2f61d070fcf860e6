"""The result of a run: its configuration, status, metrics and cost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

STATUSES = {
    "ok": "trained to the end and evaluated",
    "oom": "an allocation failed, or memory would have passed the declared limit",
    "nan": "a loss, gradient or parameter was not finite",
    "diverged": "the loss rose far above its best and stayed there, or test views are worse than one mean colour",
    "collapsed": "almost nothing was left to render",
    "exploded": "Gaussians grew far beyond the scene, or in number beyond all pixels",
    "degenerate": "images may be fine, but the depth is wrong",
    "silent": "the gradients of some parameters were always 0",
    "timeout": "the time limit came before the last iteration",
    "rejected": "the input was refused with a clear error",
}
STOP_REQUESTED = "asked to stop and score"  # `ended` of a run stopped by the user, which is no repeat of a full run
AD_HOC = "ad_hoc"  # in `experiments`: the run was also requested without an experiment
HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False}  # word in the name of a metric
SMALLEST_LOSSES = (0.05, 0.1, 0.25, 0.5, 1.0)  # dB; `padgs smallest` finds the smallest model for each
SMALLEST_STATED = 0.1  # dB; the loss of the headline number, and of the model that is kept by default
SMALLEST_PICTURED = (SMALLEST_STATED, 1.0)


@dataclass(frozen=True)
class Scores:
    """Metrics of one run under one protocol; metrics of different protocols cannot be compared."""

    protocol: dict[str, Any]  # all its rules
    metrics: dict[str, float | None]  # metric -> mean over the test views; None = missing
    views: dict[str, dict[str, float | None]]  # view -> metric -> value
    notes: tuple[str, ...] = ()  # missing metrics, with the reason


@dataclass(frozen=True)
class Result:
    """One finished run. Times are in seconds unless the name says ms; memory in bytes."""

    run: str  # run id = name of the run folder
    status: str  # key of STATUSES
    method: str  # name in `baselines.METHODS`
    preset: str  # value of `method=`: a method, or a file in conf/method
    variant: str  # row of an ablation; empty for none
    dataset: str  # synthetic, a name of padgs.data.DATASETS, or empty for own captures
    scene: str
    width: int  # of the test views, pixels
    height: int
    iterations: int  # requested; with a budget of seconds, those that were done
    iterations_done: int
    seed: int
    code_version: str
    machine: dict[str, Any]  # see `padgs.clock.machine`
    config_hash: str
    fingerprint: str  # of the data
    finished: str  # UTC, ISO 8601
    reason: str = ""  # why a run failed
    ended: str = ""  # why the run skipped part of its schedule, see `padgs.training.health`
    scores: dict[str, Scores] = field(default_factory=dict)  # protocol -> scores
    timing: dict[str, float] = field(default_factory=dict)  # train_seconds, render_ms_median, render_ms_p95, ...
    counts: dict[str, int] = field(default_factory=dict)  # anchors, gaussians, ...
    model_bytes: int = 0
    peak_memory_bytes: int = 0  # of the process, while training
    peak_device_memory_bytes: int | None = None  # of torch's tensors on the GPU, while training; None on the CPU
    config: dict[str, Any] = field(default_factory=dict)  # the resolved configuration
    experiments: tuple[str, ...] = ()  # experiments and sweeps of the run, sorted; see `joined`
    smallest: dict[str, Any] = field(default_factory=dict)  # see `padgs.runs.smallest.Search.front`

    def __post_init__(self) -> None:
        """Reject a status that is not in STATUSES."""
        if self.status not in STATUSES:
            raise ValueError(f"unknown status {self.status!r}; known: {', '.join(STATUSES)}")

    @property
    def ok(self) -> bool:
        """True if the scores count."""
        return self.status == "ok"


def joined(first: Iterable[str], second: Iterable[str]) -> tuple[str, ...]:
    """Return the experiments of a run requested by two commands; empty if neither names an experiment.

    >>> joined(("tau",), ("table1",)), joined((), ("tau",)), joined((), ())
    (('table1', 'tau'), ('ad_hoc', 'tau'), ())
    """
    names = {*(tuple(first) or (AD_HOC,)), *(tuple(second) or (AD_HOC,))}
    return () if names == {AD_HOC} else tuple(sorted(names))


def higher_is_better(metric: str) -> bool | None:
    """Return whether higher values of a metric are better; None if neither end is.

    >>> higher_is_better("ws_psnr_pole"), higher_is_better("lpips_vgg_01"), higher_is_better("seam")  # best at 1
    (True, False, None)
    """
    return next((HIGHER_IS_BETTER[word] for word in metric.split("_") if word in HIGHER_IS_BETTER), None)


# Configuration keys that results do not depend on except by rounding: those of the machine, and others. The fingerprint
# stands for the data, scoring comes after training, and the monitor may end a run but changes no number.
OF_THE_MACHINE = ("run", "render.max_instances", "data.cache_bytes", "data.prefetch_threads")
DECIDE_NOTHING = (*OF_THE_MACHINE, "data.path", "init.run", "protocol", "train.monitor")


def decisive(config: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Return a configuration without the keys of DECIDE_NOTHING.

    >>> decisive({"seed": 0, "run": {"threads": 2}, "data": {"path": "/x", "width": 64}})
    {'seed': 0, 'data': {'width': 64}}
    """
    return {
        key: decisive(value, f"{where}{key}.") if isinstance(value, Mapping) else value
        for key, value in config.items()
        if f"{where}{key}" not in DECIDE_NOTHING
    }
