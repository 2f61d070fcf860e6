"""What a method is: the one interface under which all of them are trained, timed, stressed and compared.

Methods live in `baselines/`, one file each. This file only says what they share, so that the loop around them
(`padgs.multirun.run`) knows nothing of any of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

from torch import Tensor

from padgs.render import Rendering, RenderOptions
from padgs.render.contract import CORE_SIZE
from padgs.scene import Scene, View

NEAR_UNITS = ("scene", "world")


@dataclass(frozen=True)
class RenderConfig:
    """The `render` group of the configuration. Lengths are relative to the scene until the scene is known."""

    projection: str = "erp"
    backend: str = "auto"
    near: float = 0.01  # Gaussians nearer than this are culled
    near_unit: str = "scene"  # scene: multiples of Scene.unit; world: as the published code does
    near_cull: str = "mean"
    low_pass: float = 0.3
    low_pass_kind: str = "auto"
    pixel_bias: float = 0.0
    wrap: bool = True
    bounds: str = "exact"
    cubemap: bool = False  # through six perspective faces, for the projections pinhole, tangent and ray
    face_size: int | None = None  # pixels; None: as fine as the panorama
    blending: str = "sorted"
    core_size: int = CORE_SIZE  # of blending hybrid
    memory_cap: int | None = None  # bytes; with bounds square, where the published code would run out of memory

    def __post_init__(self) -> None:
        """Reject unknown units."""
        if self.near_unit not in NEAR_UNITS:
            raise ValueError(f"unknown near_unit {self.near_unit!r}; known: {', '.join(NEAR_UNITS)}")

    def options(self, scene_unit: float) -> RenderOptions:
        """Renderer options for a scene whose own unit of length is `scene_unit` world units."""
        near = self.near * (scene_unit if self.near_unit == "scene" else 1.0)
        return RenderOptions(
            projection=self.projection,
            near=near,
            near_cull=self.near_cull,
            low_pass=self.low_pass,
            low_pass_kind=self.low_pass_kind,
            pixel_bias=self.pixel_bias,
            wrap=self.wrap,
            bounds=self.bounds,
            cubemap=self.cubemap,
            face_size=self.face_size,
            blending=self.blending,
            core_size=self.core_size,
            memory_cap=self.memory_cap,
        )


@dataclass(frozen=True)
class Budget:
    """How long a method may train."""

    iterations: int
    max_seconds: float | None = None  # training time, evaluation excluded


@dataclass(frozen=True)
class Record:
    """One training iteration, as `Method.fit` yields it after the optimiser step."""

    iteration: int  # 1 for the first step
    loss: float | Tensor  # a scalar on the GPU where nobody has read it yet: `float` of it waits for the iteration
    seconds: float  # training time so far, evaluation and files excluded
    counts: dict[str, int] = field(default_factory=dict)  # anchors, gaussians drawn, ...
    events: tuple[str, ...] = ()  # what happened besides the step: "grew 120 anchors", ...


@dataclass(frozen=True)
class State:
    """Everything that continuing bit-identically needs: tensors, and values that JSON can hold."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]


@dataclass(frozen=True)
class Size:
    """What a trained model costs to keep."""

    counts: dict[str, int]  # anchors, gaussians (potential), ...
    parameters: int  # learnable scalars
    bytes: int  # of the model alone, as stored in the checkpoint


class Failure(RuntimeError):
    """Training cannot go on; `status` is one of `padgs.results.STATUSES` and enters the tables as such."""

    def __init__(self, status: str, reason: str) -> None:
        """Keep the status beside the reason."""
        super().__init__(reason)
        self.status = status


class Method(Protocol):
    """A panoramic view-synthesis method. Constructed from its options; see `baselines.METHODS`."""

    def fit(self, scene: Scene, budget: Budget) -> Iterator[Record]:
        """Train, yielding one record per iteration; after `load_state` go on where that state was taken.

        The caller may stop between two records, at any time, and call `state()` then.

        Raises:
            Failure: the run ends with a status other than ok.
        """
        ...

    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        ...

    def state(self) -> State:
        """Model, optimiser, statistics, random state and data order."""
        ...

    def load_state(self, state: State) -> None:
        """Become the method that `state` was taken of."""
        ...

    def size(self) -> Size:
        """Counts and bytes of the model."""
        ...
