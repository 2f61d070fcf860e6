"""The camera behind most panoramas: two fisheye lenses back to back, a little apart, and stitched as if they were not.

The stitching puts both images on one sphere as if both lenses stood at the camera's centre and bent no rays. What
comes out has parallax at the plane between the lenses, the seam. Here that camera is a differentiable model: two views,
each with its own centre and rays, blended per pixel. Source: the abstract of Seam360GS (arXiv 2508.20080); the
formulas are ours (docs/methods.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor, nn

from padgs.geometry.camera import Panorama, RayTable
from padgs.geometry.lens import axis_direction, bend, check_blend, hemisphere_weight
from padgs.methods.calibration.splats import Calibration
from padgs.render import Rendering
from padgs.render.cubemap import SummedCounters
from padgs.scene import View
from padgs.training.model import TrainingRender
from padgs.training.schedule import LogLinear, ParameterGroup

DECAY = 0.1  # learning rates fall to this share over a run


class DualLens(Calibration):
    """Two lenses at centre +- (gap / 2) axis, along +- axis.

    Attributes:
        gap: [] distance between the optical centres, in scene units; positive: each lens stands on its own side.
        coefficients: [2, K] of `padgs.geometry.lens.radial_map`, of the lens along the axis and of the other.
        axis: [3] float64 of the first lens, camera frame.
        blend: radians, half width of the band in which both lenses are seen.
        unit: the scene's unit of length in world units.
    """

    axis: Tensor

    def __init__(
        self,
        *,
        axis: str = "z",
        order: int = 2,
        blend: float = 5.0,
        unit: float = 1.0,
        gap_rate: float = 1e-3,
        coefficient_rate: float = 1e-3,
    ) -> None:
        """The ideal camera: no gap, no bending.

        Args:
            axis: x, y or z.
            order: number K of coefficients of each lens.
            blend: degrees.
            unit: world units.
            gap_rate: learning rate at the start, scene units; it falls by `DECAY` over a run.
            coefficient_rate: likewise, of the coefficients.

        Raises:
            ValueError: unknown axis, a band or an order without a meaning.
        """
        super().__init__()
        if order < 1:
            raise ValueError(f"the radial map has {order} coefficients; it must have at least 1")
        self.gap = nn.Parameter(torch.zeros(()))
        self.coefficients = nn.Parameter(torch.zeros(2, order))
        self.register_buffer("axis", axis_direction(axis), persistent=False)
        self.blend, self.unit, self._axis_name = check_blend(blend), unit, axis
        self._rates = (gap_rate, coefficient_rate)

    def groups(self, iterations: int) -> list[ParameterGroup]:
        """Learning rates for a run of `iterations`."""
        gap, coefficients = (LogLinear(rate, DECAY * rate, iterations) for rate in self._rates)
        return [
            ParameterGroup("lens_gap", (self.gap,), gap, paced=False),
            ParameterGroup("lens_coefficients", (self.coefficients,), coefficients, paced=False),
        ]

    def lenses(self, view: View) -> tuple[View, View]:
        """What each lens sees of a panoramic view, on all of its pixels; differentiable by gap and coefficients.

        Raises:
            ValueError: the view is no panorama.
        """
        if not isinstance(view.camera, Panorama):
            raise ValueError(f"view {view.name!r} is a {type(view.camera).__name__}; two lenses make a Panorama")
        focal = view.camera.focal
        rays, weight = _sphere(view.camera, self._axis_name, self.blend, self.gap.device)
        given = view.cam_from_world.to(self.gap.device)
        both = []
        for sign, seen, coefficients in zip((1.0, -1.0), (weight > 0, weight < 1), self.coefficients, strict=True):
            axis = sign * self.axis
            shift = torch.zeros(4, 4, dtype=torch.float64, device=axis.device)
            shift[:3, 3] = axis
            pose = given - (0.5 * self.unit * self.gap) * shift  # the world moves the other way
            straight = rays.to(coefficients)
            # What the lens does not show stays straight: a polynomial runs off there, and bounds with it.
            table = torch.where(seen[..., None], bend(straight, axis.to(coefficients), coefficients), straight)
            both.append(replace(view, cam_from_world=pose, lens=RayTable(table, focal)))
        return both[0], both[1]

    def draw(self, draw: Callable[..., TrainingRender], view: View) -> TrainingRender:
        """The panorama as this camera stitches it; `draw(view, probe)` draws what one lens sees."""
        first, second = self.lenses(view)
        front = draw(first)
        back = draw(second, mean_offsets=front.probe)  # one probe: both lenses pull at the same Gaussians
        assert isinstance(view.camera, Panorama)
        _, weight = _sphere(view.camera, self._axis_name, self.blend, self.gap.device)
        return replace(front, rendering=stitched(front.rendering, back.rendering, weight))

    def counts(self) -> dict[str, int]:
        """The lenses."""
        return {"lenses": len(self.coefficients)}

    def values(self) -> dict[str, float]:
        """The unit."""
        return {"unit": self.unit}

    def summary(self) -> str:
        """What was found, for people."""
        k = ", ".join(f"({', '.join(f'{value:.4f}' for value in lens)})" for lens in self.coefficients.tolist())
        return f"lens gap {self.gap.item():.5f} scene units, radial coefficients {k}"


def stitched(front: Rendering, back: Rendering, weight: Tensor) -> Rendering:
    """Two renderings of the same Gaussians as one: `weight` [H, W] of the front; equal pixels stay as they are."""
    weight, visible = weight.to(front.image), front.visible | back.visible
    return Rendering(
        image=torch.lerp(back.image, front.image, weight[..., None]),
        transmittance=torch.lerp(back.transmittance, front.transmittance, weight),
        depth=torch.lerp(back.depth, front.depth, weight),
        visible=visible,
        counters=SummedCounters((front, back), visible),
    )


@lru_cache(maxsize=4)
def _sphere(camera: Panorama, axis: str, blend: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Rays [H, W, 3] and weights [H, W] of the front lens, float64."""
    rays = camera.rays(dtype=torch.float64, device=device)
    return rays, hemisphere_weight(rays, axis_direction(axis).to(device), blend)
