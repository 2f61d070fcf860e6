"""PaD-GS as a method: anchors whose Gaussians are decoded for each view, with distortion-aware opacity.

Defaults are the paper as written; conf/method/padgs_release.yaml has the deviations of its released code.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.checks import check, check_known
from padgs.methods.anchors.anchors import Decoded, PaDGS, PaDGSOptions
from padgs.methods.anchors.growth import Growth, GrowthOptions
from padgs.methods.splats.importance import importance_scores, most_important
from padgs.render import Rendering, RenderOptions, render, resolve_backend
from padgs.scene import Scene, View
from padgs.training.corrections import FISHEYES
from padgs.training.initial_points import ExtentOptions
from padgs.training.method import Method
from padgs.training.model import Parts, Size, State, TrainingRender
from padgs.training.options import AUTO, Budget
from padgs.training.schedule import PUBLISHED_ITERATIONS, Constant, LogLinear, ParameterGroup

STATED = ("voxel_size", "scene_scale", "unit", "axis")  # attributes of the anchors in a state
HEADROOM = 1.3  # capacity for the next view, in Gaussians of the last view


@dataclass(frozen=True)
class LearningRates(ExtentOptions):
    """Learning rates of Adam; pairs are start and end of a log-linear decay over the run."""

    offset_rate: tuple[float, float] = (0.05, 0.0005)  # of offsets, which are multiples of their anchor's scale
    offset_rate_unit: str = "anchor"  # the rate as it is | world: times the camera extent (released, 0.01 and 0.0001)
    feature_rate: float = 0.0075  # learning rate of anchor features
    log_scale_rate: float = 0.007  # learning rate of anchor scales
    opacity_rate: tuple[float, float] = (0.002, 2e-5)  # first and last rate of the opacity network
    color_rate: tuple[float, float] = (0.008, 5e-5)  # first and last rate of the colour network
    covariance_rate: tuple[float, float] = (0.004, 0.004)  # rates of the network of scales and rotations

    def __post_init__(self) -> None:
        check_known(self, offset_rate_unit=("anchor", "world"))
        pairs = ("offset_rate", "opacity_rate", "color_rate", "covariance_rate")
        check(self, "two rates > 0", lambda pair: all(0 < rate < math.inf for rate in pair), *pairs)
        check(self, ">= 0 and finite", lambda rate: 0 <= rate < math.inf, "feature_rate", "log_scale_rate")
        super().__post_init__()

    def groups(self, model: PaDGS, extent: float, iterations: int) -> list[ParameterGroup]:
        """Return parameter groups for a run of `iterations`; `extent` is that of the rate of offsets."""
        first, last = self.offset_rate
        rates = {
            "offsets": LogLinear(extent * first, extent * last, iterations),
            "features": Constant(self.feature_rate),
            "log_scales": Constant(self.log_scale_rate),
        }
        groups = [ParameterGroup(name, (getattr(model, name),), rate) for name, rate in rates.items()]
        for head in ("opacity", "color", "covariance"):
            weights = tuple(getattr(model.decoder, head).values())
            first, last = getattr(self, f"{head}_rate")
            groups.append(ParameterGroup(head, weights, LogLinear(first, last, iterations)))
        return groups


@dataclass(frozen=True)
class AnchorRender(TrainingRender):
    """Training render with the raw opacities of all anchors; mean offsets may have more rows than Gaussians."""

    raw_opacities: Tensor  # [A, K]


class AnchorModel:
    """A PaD-GS model (`anchors`) with its `growth`; a `padgs.training.model.Model`."""

    def __init__(
        self,
        anchors: PaDGS,
        options: RenderOptions,
        backend: str = "auto",
        *,
        growth: GrowthOptions = GrowthOptions(),  # noqa: B008 - frozen
        rates: LearningRates = LearningRates(),
        extent: float,
        iterations: int,
        seed: int = 0,
    ) -> None:
        """Wrap anchors for a run of `iterations`, with its `growth`, and the `extent` of `rates.groups`."""
        self.anchors, self.growth = anchors, Growth(anchors, growth, seed=seed)
        self._options, self._backend = options, backend
        self._rates, self._extent, self._iterations = rates, extent, iterations
        self._capacity = 0  # of the next view, in Gaussians; 0: unknown

    def groups(self) -> list[ParameterGroup]:
        """Return all learnable parameters; positions of anchors are not learned."""
        return self._rates.groups(self.anchors, self._extent, self._iterations)

    def draw(self, view: View) -> AnchorRender:
        """Decode the anchors for the view and render them, differentiably; again if cuda had too little capacity."""
        ahead = resolve_backend(self._backend, self.anchors.positions) == "cuda"
        decoded = self.anchors.decode(view, (self._capacity if ahead else 0) or None)
        rendering, offsets = self._rendered(decoded, view)
        if decoded.count() > len(decoded.slots):
            decoded = self.anchors.decode(view)
            rendering, offsets = self._rendered(decoded, view)
        count = decoded.count()
        self._capacity = max(int(HEADROOM * count) + 1, self._capacity * 15 // 16)
        drawn, gaussians = replace(rendering, visible=rendering.visible[:count]), decoded.gaussians.chosen(slice(count))
        return AnchorRender(drawn, offsets, gaussians, decoded.slots[:count], decoded.raw_opacities)

    def _rendered(self, decoded: Decoded, view: View) -> tuple[Rendering, Tensor]:
        offsets = decoded.gaussians.means.new_zeros(len(decoded.slots), 2, requires_grad=True)
        return render(decoded.gaussians, view, self._options, mean_offsets=offsets, backend=self._backend), offsets

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Collect opacities and positional gradients."""
        assert isinstance(drawing, AnchorRender), type(drawing)
        offsets = drawing.mean_offsets
        gradient = torch.zeros_like(offsets) if offsets.grad is None else offsets.grad
        gradient = gradient[: len(drawing.slots)]
        self.growth.observe(drawing.raw_opacities, drawing.slots, gradient, drawing.rendering.visible, iteration)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        return self.growth.adapt(iteration, optimizer)

    def parts(self, view: View) -> Parts:
        """Return the Gaussians decoded for the view; an anchor with its Gaussians is a row."""
        decoded = self.anchors.decode(view)
        return Parts(decoded.gaussians, decoded.slots, self.anchors.options.offsets, self._options)

    def keep(self, rows: Tensor) -> None:
        self.growth.keep(rows, None)

    def prune(self, count: int, views: Sequence[View]) -> None:
        self.keep(most_important(importance_scores(self, views), count))

    @torch.no_grad()
    def render(self, view: View) -> Rendering:
        return render(self.anchors.decode(view).gaussians, view, self._options, backend=self._backend)

    def counts(self) -> dict[str, int]:
        return {"anchors": len(self.anchors)}

    def size(self) -> Size:
        anchors = self.anchors
        counts = {"anchors": len(anchors), "gaussians": len(anchors) * anchors.options.offsets}
        return Size.of(counts, anchors.parameters(), stored=anchors.state_dict().values())

    def state(self) -> State:
        """Return parameters, growth statistics and random state; not copies."""
        tensors = {f"growth/{name}": values for name, values in self.growth.statistics.items()}
        tensors["random/growth"] = self.growth.generator.get_state()
        return State(self.anchors.state_dict() | tensors, {name: getattr(self.anchors, name) for name in STATED})

    def load_state(self, state: State) -> None:
        self.load_model(state)
        for name in self.growth.statistics:
            self.growth.statistics[name] = state.tensors[f"growth/{name}"].to(self.anchors.positions.device, copy=True)
        self.growth.generator.set_state(state.tensors["random/growth"].cpu())

    def load_model(self, state: State) -> None:
        """Load anchors and networks only; growth starts anew."""
        self.anchors.load(state.tensors)
        for name in STATED:
            setattr(self.anchors, name, state.values[name])
        self.growth.reset_statistics()


@dataclass(frozen=True)
class PaDGSMethodOptions(PaDGSOptions, GrowthOptions, LearningRates):
    """The `method` group of the configuration: the model, its growth and its learning rates."""

    def __post_init__(self) -> None:
        for part in (PaDGSOptions, GrowthOptions, LearningRates):
            part.__post_init__(self)


class PaDGSMethod(Method):
    """PaD-GS: anchors whose Gaussians are decoded for each view."""

    Options = PaDGSMethodOptions
    HAS_GAUSSIANS = True

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
        extent = self.options.extent_of(scene) if self.options.offset_rate_unit == "world" else 1.0
        anchors = PaDGS.from_scene(scene, self.options, seed=self.seed)
        is_new = self._warm_start_state is None and self._loaded_state is None
        if is_new and isinstance(self._gaussians, int) and self._gaussians < len(anchors):
            voxels = "voxel_pixels" if self.options.voxel_size == "auto" else "voxel_size"
            raise ValueError(
                f"budget.gaussians is {self._gaussians}, but training starts with {len(anchors)} anchors; increase it "
                f"or method.{voxels}"
            )
        return self._model_of(anchors, extent, iterations)

    def restore(self, state: State) -> AnchorModel:
        stored = state.of_model()
        positions, log_scales = stored.tensors["positions"], stored.tensors["log_scales"]
        stated = {name: stored.values[name] for name in STATED}
        return self._model_of(PaDGS(positions, log_scales, self.options, **stated), math.nan, PUBLISHED_ITERATIONS)

    def _model_of(self, anchors: PaDGS, extent: float, iterations: int) -> AnchorModel:
        growth = self.options.for_run(iterations)
        if isinstance(self._gaussians, int):
            growth = replace(growth, max_anchors=min(self._gaussians, growth.max_anchors or self._gaussians))
        return AnchorModel(
            anchors,
            self.render_config.options(anchors.scene_scale),
            self.render_config.backend,
            growth=growth,
            rates=self.options,
            extent=extent,
            iterations=iterations,
            seed=self.seed,
        )
