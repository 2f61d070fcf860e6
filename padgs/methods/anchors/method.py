"""PaD-GS as a method: anchors whose Gaussians are decoded for each view, with distortion-aware opacity.

Defaults are the paper as written; conf/method/padgs_release.yaml has the deviations of its released code.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace

from padgs.methods.anchors.anchors import PaDGS, PaDGSOptions
from padgs.methods.anchors.growth import GrowthOptions
from padgs.methods.anchors.model import LENGTHS, AnchorModel, LearningRates
from padgs.scene import Scene
from padgs.training.corrections import FISHEYES
from padgs.training.loop import Record, Stage
from padgs.training.method import Method
from padgs.training.model import State
from padgs.training.options import AUTO, Budget
from padgs.training.schedule import PUBLISHED_ITERATIONS


@dataclass(frozen=True)
class PaDGSMethodOptions(PaDGSOptions, GrowthOptions, LearningRates):
    """The `method` group of the configuration: the model, its growth and its learning rates."""

    scale_windows: bool = True  # windows of growth scale with the length of the run; false: absolute iterations

    def __post_init__(self) -> None:
        for part in (PaDGSOptions, GrowthOptions, LearningRates):
            part.__post_init__(self)


class PaDGSMethod(Method):
    """See `padgs.training.method.Method`."""

    Options = PaDGSMethodOptions
    _scene_scale = math.nan  # of the scene of `fit`, or of the loaded state

    def fit(self, scene: Scene, budget: Budget, *, stage: Stage = nullcontext) -> Iterator[Record]:
        """Train; see `Method.fit`."""
        self._scene_scale = scene.scale if scene.train else math.nan
        return super().fit(scene, budget, stage=stage)

    def state(self) -> State:
        """See `Method.state`; rendering a loaded model needs the scene scale, too."""
        state = super().state()
        if "scene_scale" in state.values:  # of a loaded model
            return state
        return State(state.tensors, {**state.values, "scene_scale": self._scene_scale})

    def load_state(self, state: State) -> None:
        """See `Method.load_state`."""
        self._scene_scale = state.values["scene_scale"]
        super().load_state(state)

    def _refuse_impossible(self) -> None:
        super()._refuse_impossible()
        if self.train_options.lens.startswith(FISHEYES):
            raise ValueError(
                f"train.lens is {self.train_options.lens}, which renders the same Gaussians from two places, but "
                "PaD-GS decodes others for each; set given or map, or take a method with explicit Gaussians"
            )

    def refuse_budget(self, budget: Budget) -> None:
        """Refuse a budget without a number: `budget.gaussians` counts anchors here."""
        super().refuse_budget(budget)
        if budget.gaussians == AUTO:
            raise ValueError("budget.gaussians is auto, which prunes Gaussians, but PaD-GS has anchors; set a number")

    def build_model(self, scene: Scene, iterations: int) -> AnchorModel:
        """See `Method.build_model`."""
        extent = self.options.extent_of(scene)
        extent /= scene.scale if self.options.offset_rate_unit == "scene" else 1.0
        anchors = PaDGS.from_scene(scene, self.options, seed=self.seed)
        is_new = self._warm_start_state is None and self._loaded_state is None
        if is_new and isinstance(self._gaussians, int) and self._gaussians < len(anchors):
            raise ValueError(
                f"budget.gaussians is {self._gaussians}, but training starts with {len(anchors)} anchors; increase it "
                "or method.voxel_pixels"
            )
        return self._model_of(anchors, extent, iterations)

    def restore(self, state: State) -> AnchorModel:
        """See `Method.restore`."""
        stored = state.of_model()
        positions, log_scales = stored.tensors["positions"], stored.tensors["log_scales"]
        lengths = {name: stored.values[name] for name in LENGTHS}
        return self._model_of(PaDGS(positions, log_scales, self.options, **lengths), math.nan, PUBLISHED_ITERATIONS)

    def _model_of(self, anchors: PaDGS, extent: float, iterations: int) -> AnchorModel:
        growth = self.options.for_run(iterations) if self.options.scale_windows else self.options
        if isinstance(self._gaussians, int):
            growth = replace(growth, max_anchors=min(self._gaussians, growth.max_anchors or self._gaussians))
        return AnchorModel(
            anchors,
            self.render_config.options(self._scene_scale),
            self.render_config.backend,
            growth=growth,
            rates=self.options,
            extent=extent,
            iterations=iterations,
            seed=self.seed,
        )
