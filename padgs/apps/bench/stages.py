"""One training iteration, taken apart: who had the processor when.

Stages nest, and a stage is charged only while no inner one runs, so together they are the whole iteration. The outer
ones are those of `padgs.training.loop`; native calls are told apart within them.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

from padgs.apps.bench.workload import Workload
from padgs.clock import summary
from padgs.methods.anchors.growth import GrowthOptions
from padgs.native.loading import call_hook

STAGES = {
    "target": "read the panorama, as floats",
    "decode": "anchors to Gaussians, natively",
    "project": "Gaussians to footprints and their bounds",
    "sort": "depth order, counting and binning of tile instances",
    "blend": "footprints to pixels",
    "draw": "drawing around its native calls: allocation, checks",
    "loss": "L1, SSIM and what penalties are native, with their gradients",
    "blend_backward": "pixels to moments of the footprints, and their sums",
    "project_backward": "moments to gradients of the Gaussians",
    "decode_backward": "gradients of anchors and networks",
    "backward": "autograd around the native calls",
    "observe": "densification statistics",
    "optimiser": "Adam",
    "adapt": "growing and pruning, its share of one iteration",
    "rest": "between the stages",
}
NATIVE_CALLS = {
    "padgs_decode_select": "decode",
    "padgs_decode_place": "decode",
    "padgs_project": "project",
    "padgs_depth_order": "sort",
    "padgs_tile_levels": "sort",
    "padgs_count_instances": "sort",
    "padgs_bin": "sort",
    "padgs_blend_forward": "blend",
    "padgs_angular_size": "loss",
    "padgs_photometric_loss": "loss",
    "padgs_roughness": "loss",
    "padgs_blend_backward": "blend_backward",
    "padgs_sum_moments": "blend_backward",
    "padgs_project_backward": "project_backward",
    "padgs_decode_backward": "decode_backward",
}


class StageClock:
    """Wall and CPU seconds by stage.

    Attributes:
        rounds: stage -> (wall, CPU) of every finished round.
    """

    def __init__(self) -> None:
        self.rounds: list[dict[str, tuple[float, float]]] = []
        self._spent: dict[str, tuple[float, float]] = {}
        self._running: list[str] = []
        self._since = (0.0, 0.0)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Charge what happens inside to a stage, except what inner stages are charged with."""
        self._charge()
        self._running.append(name)
        try:
            yield
        finally:
            self._charge()
            self._running.pop()

    def finish_round(self) -> None:
        """Close one round; the next starts from zero."""
        self.rounds.append(self._spent)
        self._spent = {}

    def stages(self) -> dict[str, dict[str, Any]]:
        """Stage -> {"wall", "cpu"} summaries over the rounds, in the layout of `padgs.clock.measure`."""
        names = [name for name in STAGES if any(name in spent for spent in self.rounds)]
        return {name: _summaries([spent.get(name, (0.0, 0.0)) for spent in self.rounds]) for name in names}

    def total(self) -> dict[str, Any]:
        """The same of whole rounds."""
        return _summaries([(sum(w for w, _ in r.values()), sum(c for _, c in r.values())) for r in self.rounds])

    def _charge(self) -> None:
        now = (time.perf_counter(), time.process_time())
        if self._running:
            wall, cpu = self._spent.get(self._running[-1], (0.0, 0.0))
            self._spent[self._running[-1]] = (wall + now[0] - self._since[0], cpu + now[1] - self._since[1])
        self._since = now

    def native_call(self, name: str) -> AbstractContextManager[object]:
        """A stage for `padgs.native.loading.call_hook`."""
        return self.stage(NATIVE_CALLS[name]) if name in NATIVE_CALLS else nullcontext()


def measured(work: Workload, rounds: int, warm_up: int) -> StageClock:
    """Rounds of the trainer, one iteration each."""
    clock = StageClock()
    records = work.trainer(stage=clock.stage).records()
    with call_hook(clock.native_call):
        for _ in range(warm_up + rounds):
            with clock.stage("rest"):
                next(records)
            clock.finish_round()
    del clock.rounds[:warm_up]
    return clock


def growing(work: Workload, rounds: int) -> dict[str, Any]:
    """What growing and pruning once takes, each time in the first iteration of a copy."""
    clock = StageClock()
    for _ in range(rounds):
        next(copy.deepcopy(work).trainer(grows=True, stage=clock.stage).records())
        clock.finish_round()
    return clock.stages()["adapt"]


def amortised(adapt: dict[str, Any]) -> dict[str, Any]:
    """The share that one iteration has in the cost of growing and pruning, as often as published."""
    every = GrowthOptions().grow_every
    return {
        key: {name: seconds / every for name, seconds in value.items()} if isinstance(value, dict) else value
        for key, value in adapt.items()
    }


def _summaries(rounds: list[tuple[float, float]]) -> dict[str, Any]:
    wall, cpu = zip(*rounds, strict=True)
    return {"repeats": len(rounds), "wall": summary(list(wall)), "cpu": summary(list(cpu))}
