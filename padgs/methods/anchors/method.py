"""PaD-GS as a method: anchors whose Gaussians are decoded for each view, with distortion-aware opacity.

The defaults are the paper as written; conf/method/padgs_release.yaml is its released code where it differs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass

from padgs.methods.anchors.growth import GrowthOptions
from padgs.methods.anchors.model import PaDGS, PaDGSOptions
from padgs.methods.anchors.trainee import AnchorTrainee, LearningRates
from padgs.scene import Scene
from padgs.training.loop import Record, Stage
from padgs.training.method import Method
from padgs.training.model import State
from padgs.training.options import Budget
from padgs.training.schedule import PUBLISHED_ITERATIONS


@dataclass(frozen=True)
class PaDGSMethodOptions(PaDGSOptions, GrowthOptions, LearningRates):
    """The `method` group of the configuration: the model, its growth and its learning rates, all in one list."""

    scale_windows: bool = True  # growth keeps its share of the run; false: its iterations are taken as they stand

    def __post_init__(self) -> None:
        for part in (PaDGSOptions, GrowthOptions, LearningRates):
            part.__post_init__(self)


class PaDGSMethod(Method):
    """See `padgs.training.method.Method`."""

    Options = PaDGSMethodOptions
    _scene_unit = math.nan  # of the scene of `fit`, or of the loaded state

    def fit(self, scene: Scene, budget: Budget, *, stage: Stage = nullcontext) -> Iterator[Record]:
        """Train; see `Method.fit`."""
        self._scene_unit = scene.scale if scene.train else math.nan
        return super().fit(scene, budget, stage=stage)

    def state(self) -> State:
        """See `Method.state`; rendering a loaded model takes the scene's unit, too."""
        state = super().state()
        if "scene_unit" in state.values:  # it was loaded
            return state
        return State(state.tensors, {**state.values, "scene_unit": self._scene_unit})

    def load_state(self, state: State) -> None:
        """See `Method.load_state`."""
        self._scene_unit = state.values["scene_unit"]
        super().load_state(state)

    def refuse_budget(self, budget: Budget) -> None:
        """Anchors show another number of Gaussians in each view."""
        super().refuse_budget(budget)
        if budget.gaussians is not None:
            raise ValueError(
                f"budget.gaussians is {budget.gaussians}, but anchors decode Gaussians anew for every view; limit "
                "them by method.max_anchors and method.voxel_pixels, or prune a trained run by padgs need"
            )

    def build_model(self, scene: Scene, iterations: int) -> AnchorTrainee:
        """See `Method.build_model`."""
        extent = self.options.extent_of(scene)
        extent /= scene.scale if self.options.offset_rate_unit == "scene" else 1.0
        return self._trainee_of(PaDGS.from_scene(scene, self.options, seed=self.seed), extent, iterations)

    def restore(self, state: State) -> AnchorTrainee:
        """See `Method.restore`."""
        stored = state.of_model()
        positions, log_scales = stored.tensors["positions"], stored.tensors["log_scales"]
        unit, voxel_size = stored.values["unit"], stored.values["voxel_size"]
        model = PaDGS(positions, log_scales, self.options, voxel_size=voxel_size, unit=unit)
        return self._trainee_of(model, math.nan, PUBLISHED_ITERATIONS)

    def _trainee_of(self, model: PaDGS, extent: float, iterations: int) -> AnchorTrainee:
        return AnchorTrainee(
            model,
            self.render_config.options(self._scene_unit),
            self.render_config.backend,
            growth=self.options.for_run(iterations) if self.options.scale_windows else self.options,
            rates=self.options,
            extent=extent,
            iterations=iterations,
            seed=self.seed,
        )
