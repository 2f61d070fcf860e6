"""PaD-GS as a method: anchors whose Gaussians are decoded for each view, with distortion-aware opacity.

Presets: `padgs`, the paper as written, and `padgs_release`, the released code where it differs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch

from padgs.anchors.growth import RELEASED_GROWTH, Growth, GrowthOptions
from padgs.anchors.model import RELEASED_MODEL, PaDGS, PaDGSOptions
from padgs.anchors.trainee import TrainablePaDGS
from padgs.learning.method import Budget, Record, RenderConfig, Size, State
from padgs.learning.schedule import Constant, LogLinear, ParameterGroup
from padgs.learning.views import Trainer, TrainOptions, model_state
from padgs.render import Rendering, render
from padgs.scene import Scene, View
from padgs.splats.trainee import extent_of

OFFSET_RATE_UNITS = ("scene", "world")


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of Adam; pairs are the first and the last of a log-linear decay over the run."""

    offset_rate: tuple[float, float] = (0.01, 0.0001)  # times the extent of the cameras in `offset_rate_unit`
    offset_rate_unit: str = "scene"  # scene: Scene.unit, so the world's units do not matter | world: as published
    feature_rate: float = 0.0075
    log_scale_rate: float = 0.007
    opacity_rate: tuple[float, float] = (0.002, 2e-5)  # the three networks
    color_rate: tuple[float, float] = (0.008, 5e-5)
    covariance_rate: tuple[float, float] = (0.004, 0.004)

    def __post_init__(self) -> None:
        """Reject unknown units."""
        if self.offset_rate_unit not in OFFSET_RATE_UNITS:
            known = ", ".join(OFFSET_RATE_UNITS)
            raise ValueError(f"unknown offset_rate_unit {self.offset_rate_unit!r}; known: {known}")

    def groups(self, model: PaDGS, scene: Scene, iterations: int) -> list[ParameterGroup]:
        """The parameters of a model with their rates in a run of `iterations` on a scene."""
        travel = extent_of(scene) / (scene.unit if self.offset_rate_unit == "scene" else 1.0)
        first, last = self.offset_rate
        groups = [
            ParameterGroup("offsets", (model.offsets,), LogLinear(travel * first, travel * last, iterations)),
            ParameterGroup("features", (model.features,), Constant(self.feature_rate)),
            ParameterGroup("log_scales", (model.log_scales,), Constant(self.log_scale_rate)),
        ]
        for head in ("opacity", "color", "covariance"):
            weights = tuple(getattr(model.decoder, head).values())
            first, last = getattr(self, f"{head}_rate")
            groups.append(ParameterGroup(head, weights, LogLinear(first, last, iterations)))
        return groups


@dataclass(frozen=True)
class PaDGSMethodOptions(PaDGSOptions, GrowthOptions, LearningRates):
    """The `method` group of the configuration: the model, its growth and its learning rates, all in one list."""

    scale_windows: bool = True  # growth keeps its share of the run; false: its iterations are taken as they stand

    def __post_init__(self) -> None:
        """Check every part."""
        for part in (PaDGSOptions, GrowthOptions, LearningRates):
            part.__post_init__(self)


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "padgs": {"method": {}, "render": {}, "train": {}},
    "padgs_release": {
        "method": {**RELEASED_MODEL, **RELEASED_GROWTH, "offset_rate_unit": "world"},
        "render": {"near": 0.2, "near_unit": "world", "wrap": False, "bounds": "square"},
        "train": {"weight": "end_rows", "normalisation": "channel_sum"},
    },
}


def preset(name: str) -> tuple[PaDGSMethodOptions, RenderConfig, TrainOptions]:
    """The three groups of options of a preset.

    Raises:
        ValueError: no such preset.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}; known: {', '.join(PRESETS)}")
    of = PRESETS[name]
    return PaDGSMethodOptions(**of["method"]), RenderConfig(**of["render"]), TrainOptions(**of["train"])


class PaDGSMethod:
    """`padgs.learning.method.Method`."""

    Options = PaDGSMethodOptions

    def __init__(
        self,
        options: PaDGSMethodOptions = PaDGSMethodOptions(),
        render: RenderConfig = RenderConfig(),  # noqa: B008
        train: TrainOptions = TrainOptions(),  # noqa: B008
        seed: int = 0,
    ) -> None:
        """A method without a model yet; `fit` or `load_state` makes it."""
        self.options, self.render_config, self.train_options, self.seed = options, render, train, seed
        self._model: PaDGS | None = None
        self._scene_unit = 0.0
        self._trainer: Trainer | None = None
        self._start: State | None = None

    def fit(self, scene: Scene, budget: Budget) -> Iterator[Record]:
        """Train, from the point cloud or from where the loaded state was taken; see `padgs.learning.method.Method`."""
        if self._start is None:
            self._model = PaDGS.from_scene(scene, self.options, seed=self.seed)
        self._scene_unit = scene.unit
        growth = self.options.for_run(budget.iterations) if self.options.scale_windows else self.options
        trainee = TrainablePaDGS(
            self.model,
            Growth(self.model, growth, seed=self.seed),
            self.options.groups(self.model, scene, budget.iterations),
            self.render_config.options(scene.unit),
            self.render_config.backend,
        )
        self._trainer = Trainer(trainee, scene, budget, self.train_options, self.seed)
        if self._start is not None:
            self._trainer.load_state(self._start)
            self._start = None
        return self._trainer.records()

    @property
    def model(self) -> PaDGS:
        """The model.

        Raises:
            RuntimeError: neither `fit` nor `load_state` has been called.
        """
        if self._model is None:
            raise RuntimeError("PaD-GS has no model yet; call fit or load_state first")
        return self._model

    @torch.no_grad()
    def render(self, view: View) -> Rendering:
        """Decode and render a view without gradients."""
        options = self.render_config.options(self._scene_unit)
        return render(self.model.decode(view).gaussians, view, options, backend=self.render_config.backend)

    def state(self) -> State:
        """Everything that going on bit-identically needs.

        Raises:
            RuntimeError: neither `fit` nor `load_state` has been called.
        """
        if self._trainer is not None:
            state = self._trainer.state()
            return State(state.tensors, {**state.values, "scene_unit": self._scene_unit})
        if self._start is not None:
            return self._start
        raise RuntimeError("PaD-GS has no state yet; call fit or load_state first")

    def load_state(self, state: State) -> None:
        """Become the method that `state` was taken of; `render` works at once, `fit` goes on from there."""
        stored = model_state(state)
        positions, log_scales = stored.tensors["positions"], stored.tensors["log_scales"]
        unit, voxel_size = stored.values["unit"], stored.values["voxel_size"]
        model = PaDGS(positions, log_scales, self.options, voxel_size=voxel_size, unit=unit)
        model.load(stored.tensors)
        self._model, self._start, self._trainer = model, state, None
        self._scene_unit = state.values["scene_unit"]

    def size(self) -> Size:
        """Anchors, the Gaussians that they can show, and the bytes of the stored model."""
        model = self.model
        counts = {"anchors": len(model), "gaussians": len(model) * model.options.offsets}
        tensors = model.state_dict().values()
        return Size(
            counts,
            parameters=sum(p.numel() for p in model.parameters()),
            bytes=sum(t.numel() * t.element_size() for t in tensors),
        )
