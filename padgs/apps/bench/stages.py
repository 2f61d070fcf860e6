"""The stages of a training iteration: by wall and CPU time on the CPU, by kernels on a GPU.

On the CPU stages nest, and a stage is charged only while no inner one runs, so that together they are the whole
iteration. `padgs.training.loop` has the outer stages; native calls are inner ones.
"""

import copy
import re
import time
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch

from padgs import clock
from padgs.apps.bench.workload import Workload
from padgs.methods.anchors.growth import GrowthOptions
from padgs.native.loading import call_hook

STAGES = {
    "target": "read the panorama as floats",
    "decode": "anchors to Gaussians",
    "project": "Gaussians to footprints and their bounds",
    "sort": "depth order, counting and binning of tile instances",
    "blend": "footprints to pixels",
    "draw": "rendering around its native calls: allocation, checks",
    "loss": "L1, SSIM and native penalties, with their gradients",
    "blend_backward": "gradients of pixels to sums over footprints",
    "project_backward": "sums over footprints to gradients of Gaussians",
    "decode_backward": "gradients of anchors and networks",
    "backward": "autograd around the native calls",
    "observe": "densification statistics",
    "optimizer": "Adam",
    "adapt": "densification and pruning, as a share of one iteration",
    "rest": "between the stages",
}
NATIVE_CALLS = {
    **dict.fromkeys(("padgs_decode_select", "padgs_decode_place"), "decode"),
    "padgs_project": "project",
    **dict.fromkeys(("padgs_depth_order", "padgs_tile_levels", "padgs_count_instances", "padgs_bin"), "sort"),
    "padgs_blend_forward": "blend",
    **dict.fromkeys(("padgs_photometric_loss", "padgs_roughness"), "loss"),
    **dict.fromkeys(("padgs_blend_backward", "padgs_sum_moments"), "blend_backward"),
    "padgs_project_backward": "project_backward",
    "padgs_decode_backward": "decode_backward",
}
WARM_UP = 2  # iterations before those that are measured
DENSIFICATIONS = 2  # measured steps of densification


class StageClock:
    """Wall and CPU seconds by stage; `rounds` has stage -> (wall, CPU) seconds of each finished iteration."""

    def __init__(self) -> None:
        self.rounds: list[dict[str, tuple[float, float]]] = []
        self._spent: dict[str, tuple[float, float]] = {}
        self._running: list[str] = []
        self._since = (0.0, 0.0)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Charge the time inside to a stage, except that of inner stages."""
        self._charge()
        self._running.append(name)
        try:
            yield
        finally:
            self._charge()
            self._running.pop()

    def native_call(self, name: str) -> AbstractContextManager[object]:
        """Return the stage of a native call, for `padgs.native.loading.call_hook`."""
        return self.stage(NATIVE_CALLS[name]) if name in NATIVE_CALLS else nullcontext()

    def finish_round(self) -> None:
        """Close an iteration; the next one starts from zero."""
        self.rounds.append(self._spent)
        self._spent = {}

    def stages(self) -> dict[str, dict[str, float]]:
        """Return stage -> least CPU "seconds" and least "wall" seconds of all iterations."""
        found = {}
        for name in STAGES:
            if spent := [one[name] for one in self.rounds if name in one]:
                wall, cpu = map(min, zip(*spent, strict=True))
                found[name] = {"seconds": cpu, "wall": wall}
        return found

    def _charge(self) -> None:
        now = (time.perf_counter(), time.process_time())
        if self._running:
            wall, cpu = self._spent.get(self._running[-1], (0.0, 0.0))
            self._spent[self._running[-1]] = (wall + now[0] - self._since[0], cpu + now[1] - self._since[1])
        self._since = now


def cpu_stages(work: Workload, rounds: int) -> dict[str, dict[str, float]]:
    """Return the least CPU and wall seconds of each stage; densification is spread over the iterations between two."""
    stages, densification = StageClock(), StageClock()
    records = work.trainer(stage=stages.stage).records()
    with call_hook(stages.native_call):
        for _ in range(WARM_UP + rounds):
            with stages.stage("rest"):
                next(records)
            stages.finish_round()
    del stages.rounds[:WARM_UP]
    for _ in range(DENSIFICATIONS):
        next(copy.deepcopy(work).trainer(grows=True, stage=densification.stage).records())
        densification.finish_round()
    every = GrowthOptions().grow_every
    adapt = {name: seconds / every for name, seconds in densification.stages()["adapt"].items()}
    found = stages.stages() | {"adapt": adapt}
    return {name: found[name] for name in STAGES}


def device_stages(work: Workload, rounds: int, device: torch.device) -> dict[str, dict[str, float]]:
    """Return kernel -> "seconds" on the device and "calls" in an iteration, by torch.profiler, the slowest first."""
    from torch.profiler import ProfilerActivity, profile

    records = work.trainer().records()
    for _ in range(WARM_UP):
        next(records)
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if device.type == "cuda" else [])]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(Warning: )?Profiler clears events")  # there is one cycle
        with profile(activities=activities) as profiler:
            for _ in range(rounds):
                next(records)
            clock.synchronise(device)
    found: dict[str, dict[str, float]] = {}
    for event in profiler.key_averages():
        if event.device_type.name.lower() == device.type and not getattr(event, "is_user_annotation", False):
            micros = event.self_cpu_time_total if device.type == "cpu" else event.self_device_time_total
            entry = found.setdefault(kernel_name(event.key), {"seconds": 0.0, "calls": 0.0})
            entry["seconds"] += micros / 1e6 / rounds
            entry["calls"] += event.count / rounds
    return dict(sorted(found.items(), key=lambda item: -item[1]["seconds"]))


def kernel_name(signature: str) -> str:
    """Return a kernel's name without return type, template arguments and parameters."""
    name = signature.removeprefix("void ").replace("(anonymous namespace)::", "")
    return re.split(r"[<(]", name)[0].strip() or signature
