"""One training iteration, taken apart: who had the processor when.

Stages nest, and a stage is charged only while no inner one runs, so together they are the whole iteration. The parts of
the renderer are told apart by watching the native calls that it makes; what it does around them is a stage of its own.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch

from padgs.anchors.growth import Growth, GrowthOptions
from padgs.anchors.model import Decoded
from padgs.bench.workload import OPTIONS, Workload
from padgs.clock import summary
from padgs.learning.loss import photometric_loss
from padgs.learning.targets import Targets
from padgs.native import cpu
from padgs.render import render

STAGES = {
    "target": "read the panorama, as floats",
    "decode": "anchors to Gaussians",
    "project": "Gaussians to footprints and their bounds",
    "sort": "depth order, counting and binning of tile instances",
    "blend": "footprints to pixels",
    "render_rest": "renderer around its native calls: allocation, checks",
    "loss": "L1 and SSIM, with their gradient",
    "blend_backward": "pixels to moments of the footprints, and their sums",
    "project_backward": "moments to gradients of the Gaussians",
    "decode_backward": "gradients of anchors and networks",
    "backward_rest": "autograd around the native calls",
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
    "padgs_photometric_loss": "loss",
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
        """Nothing measured yet."""
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


@contextmanager
def native_calls_watched(clock: StageClock) -> Iterator[None]:
    """Charge every native call to its stage, wherever it is made from."""
    watched = _WatchedLibrary(cpu.library(), clock)
    with mock.patch.object(cpu, "library", lambda: watched):
        yield


class _WatchedLibrary:
    def __init__(self, library: Any, clock: StageClock) -> None:
        self._library, self._clock = library, clock

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._library, name)
        if name not in NATIVE_CALLS:
            return function

        def call(*arguments):
            with self._clock.stage(NATIVE_CALLS[name]):
                return function(*arguments)

        return call


class Iteration:
    """The training iteration of `padgs.learning.views.Trainer`, with a stage around each of its steps."""

    def __init__(self, work: Workload) -> None:
        """Prepare as the trainer does."""
        self.work = work
        groups = work.groups()
        self.optimizer = torch.optim.Adam(
            [{"params": list(group.parameters), "lr": 0.0} for group in groups], eps=1e-15, fused=True
        )
        self.targets = Targets(work.scene.train, "solid_angle")
        self.growth = work.watching_growth()
        self.counters: dict[str, int] = {}

    def run(self, clock: StageClock) -> None:
        """One round."""
        with clock.stage("rest"), native_calls_watched(clock):
            with clock.stage("target"):
                target = self.targets[len(clock.rounds) % len(self.targets)]
            decoded, probe, visible = self._backward(clock, target)
            with clock.stage("observe"), torch.no_grad():
                self._observe(self.growth, decoded, probe, visible)
            with clock.stage("optimiser"):
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
        clock.finish_round()

    def adapt(self, clock: StageClock) -> tuple[str, ...]:
        """Grow and prune once, on a copy; charges the share of one of the iterations between two such events."""
        twin = Iteration(copy.deepcopy(self.work))
        growth = twin.work.acting_growth()
        decoded, probe, visible = twin._backward(StageClock(), twin.targets[0])
        with torch.no_grad():
            twin._observe(growth, decoded, probe, visible)
            del decoded, probe, visible
            twin.optimizer.step()
            with clock.stage("adapt"):
                events = growth.adapt(1, twin.optimizer)
        clock.finish_round()
        return events

    def _backward(self, clock: StageClock, target):
        view = self.work.view
        with clock.stage("decode"):
            decoded = self.work.model.decode(view)
        with clock.stage("render_rest"):
            probe = decoded.gaussians.means.new_zeros(len(decoded.slots), 2, requires_grad=True)
            rendering = render(decoded.gaussians, view, OPTIONS, probe=probe, backend="cpu")
        with clock.stage("loss"):
            loss = photometric_loss(rendering.image, target.image, target.weight)
            loss.item()
        with clock.stage("backward_rest"):
            loss.backward()
        self.counters = dict(rendering.counters)
        return decoded, probe, rendering.visible

    @staticmethod
    def _observe(growth: Growth, decoded: Decoded, probe: torch.Tensor, visible: torch.Tensor) -> None:
        assert probe.grad is not None
        growth.observe(decoded.raw_opacities, decoded.slots, probe.grad, visible, iteration=1)


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
