"""PaD-GS in training: a model, its growth and its learning rates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.checks import check, check_known
from padgs.methods.anchors.growth import Growth, GrowthOptions
from padgs.methods.anchors.model import Decoded, PaDGS
from padgs.render import Rendering, RenderOptions, render, resolve_backend
from padgs.scene import View
from padgs.training.initial_points import ExtentOptions
from padgs.training.model import Parts, Size, State, TrainingRender
from padgs.training.schedule import Constant, LogLinear, ParameterGroup

OFFSET_RATE_UNITS = ("scene", "world")
HEADROOM = 1.3  # room for so many times the Gaussians that the last view showed


@dataclass(frozen=True)
class LearningRates(ExtentOptions):
    """Learning rates of Adam; pairs are the first and the last of a log-linear decay over the run."""

    offset_rate: tuple[float, float] = (0.01, 0.0001)  # times the extent of the cameras in `offset_rate_unit`
    offset_rate_unit: str = "world"  # world: as released | scene: Scene.scale, so the world's units do not matter
    feature_rate: float = 0.0075  # of the features of anchors
    log_scale_rate: float = 0.007  # of the scales of anchors
    opacity_rate: tuple[float, float] = (0.002, 2e-5)  # of the network that decodes opacities
    color_rate: tuple[float, float] = (0.008, 5e-5)  # ... colours
    covariance_rate: tuple[float, float] = (0.004, 0.004)  # ... scales and rotations

    def __post_init__(self) -> None:
        check_known(self, offset_rate_unit=OFFSET_RATE_UNITS)
        pairs = ("offset_rate", "opacity_rate", "color_rate", "covariance_rate")
        check(self, "two rates > 0", lambda pair: all(0 < rate < math.inf for rate in pair), *pairs)
        check(self, ">= 0 and finite", lambda rate: 0 <= rate < math.inf, "feature_rate", "log_scale_rate")
        super().__post_init__()

    def groups(self, model: PaDGS, extent: float, iterations: int) -> list[ParameterGroup]:
        """The parameters of a model with their rates in a run of `iterations`; `extent` in `offset_rate_unit`."""
        first, last = self.offset_rate
        groups = [
            ParameterGroup(name, (getattr(model, name),), rate, is_of_rows=True)
            for name, rate in (
                ("offsets", LogLinear(extent * first, extent * last, iterations)),
                ("features", Constant(self.feature_rate)),
                ("log_scales", Constant(self.log_scale_rate)),
            )
        ]
        for head in ("opacity", "color", "covariance"):
            weights = tuple(getattr(model.decoder, head).values())
            first, last = getattr(self, f"{head}_rate")
            groups.append(ParameterGroup(head, weights, LogLinear(first, last, iterations)))
        return groups


@dataclass(frozen=True)
class AnchorDrawing(TrainingRender):
    """A drawing that remembers the opacities of all anchors, which decide what is pruned.

    Its probe may have more rows than there are Gaussians; the first are theirs.
    """

    raw_opacities: Tensor  # [A, K]


class AnchorTrainee:
    """A PaD-GS model with its growth; a `padgs.training.model.Model`.

    Attributes:
        model, growth: what is trained, and what densifies it.
    """

    def __init__(
        self,
        model: PaDGS,
        options: RenderOptions,
        backend: str = "auto",
        *,
        growth: GrowthOptions = GrowthOptions(),  # noqa: B008 - frozen
        rates: LearningRates = LearningRates(),
        extent: float,
        iterations: int,
        seed: int = 0,
    ) -> None:
        """Wrap a model.

        Args:
            model: what is trained.
            options, backend: how it is drawn.
            growth: as it is in this run, see `GrowthOptions.for_run`.
            rates: learning rates.
            extent: of the cameras, in `rates.offset_rate_unit`.
            iterations: of the run.
            seed: of the random choices of growth.
        """
        self.model, self.growth = model, Growth(model, growth, seed=seed)
        self._options, self._backend = options, backend
        self._rates, self._extent, self._iterations = rates, extent, iterations
        self._room = 0  # for the Gaussians of the next view; 0: as many as there are

    def groups(self) -> list[ParameterGroup]:
        """All learnable parameters; positions of anchors are none."""
        return self._rates.groups(self.model, self._extent, self._iterations)

    def draw(self, view: View) -> AnchorDrawing:
        """Decode the anchors for the view and render them, differentiably.

        Backend cuda need not be told how many Gaussians there are: there is room for more than the last view showed,
        and the number is read while they are drawn. Where there was too little room, all is done once more.
        """
        ahead = resolve_backend(self._backend, self.model.positions) == "cuda"
        decoded = self.model.decode(view, (self._room if ahead else 0) or None)
        rendering, probe = self._rendered(decoded, view)
        if decoded.count() > len(decoded.slots):
            decoded = self.model.decode(view)
            rendering, probe = self._rendered(decoded, view)
        count = decoded.count()
        self._room = max(int(HEADROOM * count) + 1, self._room * 15 // 16)
        drawn = replace(rendering, visible=rendering.visible[:count])
        return AnchorDrawing(drawn, probe, decoded.gaussians.first(count), decoded.slots[:count], decoded.raw_opacities)

    def _rendered(self, decoded: Decoded, view: View) -> tuple[Rendering, Tensor]:
        probe = decoded.gaussians.means.new_zeros(len(decoded.slots), 2, requires_grad=True)
        return render(decoded.gaussians, view, self._options, mean_offsets=probe, backend=self._backend), probe

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Collect opacities and image-plane gradients."""
        assert isinstance(drawing, AnchorDrawing), type(drawing)
        gradient = drawing.probe.grad if drawing.probe.grad is not None else torch.zeros_like(drawing.probe)
        gradient = gradient[: len(drawing.slots)]
        self.growth.observe(drawing.raw_opacities, drawing.slots, gradient, drawing.rendering.visible, iteration)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Grow and prune anchors."""
        return self.growth.adapt(iteration, optimizer)

    def parts(self, view: View) -> Parts:
        """The Gaussians that the view shows; an anchor with all of its own is a row."""
        decoded = self.model.decode(view)
        return Parts(decoded.gaussians, decoded.slots, self.model.options.offsets, self._options)

    def keep(self, rows: Tensor) -> None:
        """Keep these anchors only."""
        self.growth.keep(rows, None)

    @torch.no_grad()
    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        return render(self.model.decode(view).gaussians, view, self._options, backend=self._backend)

    def counts(self) -> dict[str, int]:
        """Number of anchors."""
        return {"anchors": len(self.model)}

    def size(self) -> Size:
        """Anchors, the Gaussians that they can show, and the bytes of the stored model."""
        model = self.model
        counts = {"anchors": len(model), "gaussians": len(model) * model.options.offsets}
        return Size.of(counts, model.parameters(), stored=model.state_dict().values())

    def state(self) -> State:
        """Model, growth statistics and random state."""
        growth = {f"growth/{name}": values for name, values in self.growth.statistics.items()}
        values = {"voxel_size": self.model.voxel_size, "unit": self.model.unit}
        return State({**self.model.state_dict(), **growth, "random/growth": self.growth.generator.get_state()}, values)

    def load_state(self, state: State) -> None:
        """Become what `state` was taken of, whatever the number of anchors."""
        self.load_model(state)
        for name in self.growth.statistics:
            self.growth.statistics[name] = state.tensors[f"growth/{name}"].to(self.model.positions.device, copy=True)
        self.growth.generator.set_state(state.tensors["random/growth"].cpu())

    def load_model(self, state: State) -> None:
        """Take the anchors and networks alone, whose growth begins anew."""
        self.model.load(state.tensors)
        self.model.voxel_size, self.model.unit = state.values["voxel_size"], state.values["unit"]
        self.growth.forget()
