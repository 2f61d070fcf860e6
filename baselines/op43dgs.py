"""OP43DGS ("optimal projection", Huang et al. 2024): explicit Gaussians on the tangent plane of the sphere at a mean.

conf/method/op43dgs_release.yaml has the deviations of its released code: bounds that grow with the distance of a
Gaussian in world units, a low-pass that does not depend on the image size, and the memory that both exhaust.
"""

from dataclasses import dataclass, replace
from typing import Any

from padgs.checks import check
from padgs.gaussians import Gaussians
from padgs.methods.splats.method import SplatMethod, SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.render import RenderConfig, Rendering, RenderOptions
from padgs.render.projective import PUBLISHED_FOCAL
from padgs.scene import View

INSTANCE_BYTES = 24  # per (Gaussian, tile) pair: a key of 8 bytes and a value of 4, before and after sorting


@dataclass(frozen=True)
class OP43DGSOptions(SplatOptions):
    """Options as published; those defined here are deviations of the released code."""

    fixed_low_pass: bool = False  # render.low_pass is in pixels of `PUBLISHED_FOCAL`
    memory_cap: int | None = None  # bytes for all (Gaussian, tile) pairs of an image; None: unlimited

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "at least 1 byte, or null", lambda cap: cap is None or cap >= 1, "memory_cap")


class OP43DGSModel(SplatModel):
    """Splats with the deviations of the released code."""

    options: OP43DGSOptions

    def render_options(self, view: View) -> RenderOptions:
        options = super().render_options(view)
        if not self.options.fixed_low_pass:
            return options
        return replace(options, low_pass=options.low_pass * (view.camera.focal / PUBLISHED_FOCAL) ** 2)

    def _rendered(self, gaussians: Gaussians, view: View, options: RenderOptions, **offsets: Any) -> Rendering:
        rendering, cap = super()._rendered(gaussians, view, options, **offsets), self.options.memory_cap
        instances = rendering.counters.get("instances", 0) if cap else 0
        if cap and (needed := instances * INSTANCE_BYTES) > cap:
            raise MemoryError(
                f"{instances:,} (Gaussian, tile) instances of {INSTANCE_BYTES} bytes are {needed:,} bytes at once; "
                f"memory_cap is {cap:,}"
            )
        return rendering


class OP43DGSMethod(SplatMethod):
    """OP43DGS (Huang et al. 2024): tangent planes, and learning rates by its own law."""

    Options = OP43DGSOptions
    MODEL = OP43DGSModel
    RENDER = RenderConfig(projection="tangent")
    RUN_RATES = "run_linear"

    @property
    def has_smoothing_filter(self) -> bool:
        """True if the low-pass is the same angle for every camera."""
        return self.options.fixed_low_pass
