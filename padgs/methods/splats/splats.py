"""Explicit 3D Gaussians with spherical harmonics: the parameters of 3DGS and of all methods of its family."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from padgs.gaussians import Gaussians
from padgs.geometry import harmonics
from padgs.methods.splats.native_splats import Parameters, native_call, native_splats
from padgs.scene import Scene, View
from padgs.training.initial_points import refuse_unusable, squared_spacing
from padgs.training.optimizer import load_rows

INITIAL_OPACITY = 0.1
MIN_INITIAL_SCALE = 1e-4  # of coinciding points, in scene units
MIN_INITIAL_COLOR = 1 / 1024  # a colour of exactly 0 would be clamped after rounding and get no gradient
TINY = 1e-6  # scene units; keeps directions finite for a camera exactly on a Gaussian


class Splats(nn.Module):
    """N Gaussians, stored as they are learned: log-scales, opacity logits, SH coefficients.

    Attributes:
        means: [N, 3] world.
        quats: [N, 4] wxyz, not normalised.
        log_scales: [N, 3] of world units.
        opacity_logits: [N].
        sh_dc: [N, 3] colour coefficients of degree 0.
        sh_rest: [N, (degree + 1)^2 - 1, 3] coefficients of higher degrees.
        active_degree: SH degree in use; coefficients above it get no gradient.
        scene_scale: `Scene.scale`, world units.
    """

    def __init__(
        self,
        means: Tensor,
        log_scales: Tensor,
        colors: Tensor,
        *,
        degree: int = 3,
        scene_scale: float = 1.0,
        opacity: float = INITIAL_OPACITY,
    ) -> None:
        """Build Gaussians without rotation: means [N, 3], log-scales [N, 3], RGB in [0, 1] [N, 3], one opacity."""
        super().__init__()
        count = len(means)
        self.degree, self.active_degree, self.scene_scale = degree, 0, scene_scale
        self.means = nn.Parameter(means.clone())
        self.quats = nn.Parameter(means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1))
        self.log_scales = nn.Parameter(log_scales.clone())
        self.opacity_logits = nn.Parameter(means.new_full((count,), math.log(opacity / (1 - opacity))))
        self.sh_dc = nn.Parameter(harmonics.dc_from_colors(colors.clamp(min=MIN_INITIAL_COLOR)))
        self.sh_rest = nn.Parameter(means.new_zeros(count, (degree + 1) ** 2 - 1, 3))

    @classmethod
    def from_scene(
        cls,
        scene: Scene,
        *,
        degree: int = 3,
        max_gaussians: int | None = None,
        opacity: float = INITIAL_OPACITY,
        scale: float = 1.0,
        generator: torch.Generator,
    ) -> Splats:
        """Return one Gaussian per point, or a random `max_gaussians`; `scale` is a factor on `initial_scales`."""
        points, colors = scene.points.float(), scene.point_colors.float() / 255
        refuse_unusable(points, "Gaussians")
        if max_gaussians is not None and len(points) > max_gaussians:
            chosen = torch.randperm(len(points), generator=generator)[:max_gaussians].sort().values
            points, colors = points[chosen], colors[chosen]
        log_scales = torch.log(scale * initial_scales(points, scene.scale))[:, None].repeat(1, 3)
        return cls(points, log_scales, colors, degree=degree, scene_scale=scene.scale, opacity=opacity)

    def __len__(self) -> int:
        return len(self.means)

    def rows(self) -> dict[str, nn.Parameter]:
        """Return all parameters by name; each has one row per Gaussian."""
        return dict(self.named_parameters())

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Copy the `state_dict` of another model, whose number of Gaussians may differ."""
        load_rows(self, tensors, self.rows())

    def gaussians(self, view: View) -> Gaussians:
        """Return the Gaussians with their colours as seen from a view."""
        return self.displaced(view)[0]

    def displaced(self, view: View, mean_offsets: Tensor | None = None) -> tuple[Gaussians, Tensor | None]:
        """Return the Gaussians with their means displaced by offsets, which exist for their gradient.

        Colours are those seen from the view. `mean_offsets` [N, 3] are along world axes in units of half the distance
        to the camera; or [N, 4], whose last column receives absolute gradients in the same unit, and is returned [N] in
        world units.
        """
        center, tiny = view.center.to(self.means), TINY * self.scene_scale
        if (call := native_call(self.means, center)) is not None:
            parameters = (self.means, self.log_scales, self.opacity_logits, self.sh_dc, self.sh_rest)
            native = native_splats(Parameters(*parameters, mean_offsets), self.active_degree, center, tiny, call)
            gaussians = Gaussians(native.means, self.quats, native.scales, native.opacities, native.colors)
            return gaussians, native.absolute_offsets
        means, absolute = self.means, None
        if mean_offsets is not None:
            steps = 0.5 * (means.detach() - center).norm(dim=-1, keepdim=True) * mean_offsets
            means, absolute = means + steps[:, :3], steps[:, 3] if steps.shape[1] > 3 else None
        opacities, colors = torch.sigmoid(self.opacity_logits), self._colors(means, center, tiny)
        return Gaussians(means, self.quats, torch.exp(self.log_scales), opacities, colors), absolute

    def _colors(self, means: Tensor, center: Tensor, tiny: float) -> Tensor:
        """Return max(0, 1/2 + SH), [N, 3], along camera -> Gaussian in the world frame."""
        colors = 0.5 + harmonics.DC * self.sh_dc
        if self.active_degree > 0:
            rays = means - center
            directions = rays / torch.sqrt((rays * rays).sum(-1, keepdim=True) + tiny**2)
            values = harmonics.basis(directions, self.active_degree)[:, 1:]  # [N, K]
            # No einsum, which on a GPU is a tiny matrix product for each Gaussian.
            colors = colors + (values[..., None] * self.sh_rest[:, : values.shape[1]]).sum(1)
        return colors.clamp(min=0)


def initial_scales(points: Tensor, scene_scale: float) -> Tensor:
    """Return the RMS distance [N] of points to three neighbours, bounded below; 0.1 scene scales for a single one."""
    squared = squared_spacing(points)
    if squared is None:
        return points.new_full((len(points),), 0.1 * scene_scale)
    return squared.sqrt().clamp(min=MIN_INITIAL_SCALE * scene_scale).to(points)
