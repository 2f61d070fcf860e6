"""Explicit 3D Gaussians with spherical harmonics: the model of 3DGS and OmniGS, and the ablation's baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from padgs.gaussians import Gaussians
from padgs.geometry import harmonics as spherical_harmonics
from padgs.methods.splats import cpu_splats, gpu_splats
from padgs.scene import Scene, View
from padgs.training.initial_points import refuse_unusable, squared_spacing
from padgs.training.optimizer import load_rows

INITIAL_OPACITY = 0.1
SMALLEST_SCALE = 1e-4  # initial scale of coinciding points, in scene units
DARKEST = 1 / 1024  # initial colour; one of exactly 0 is cut off at 0 by rounding, where nothing pulls at it
TINY = 1e-6  # scene units; keeps directions finite for a camera exactly on a Gaussian


class Splats(nn.Module):
    """N Gaussians, stored as they are learned: log-scales, opacity logits, SH coefficients.

    Attributes:
        means: [N, 3] world.
        quats: [N, 4] wxyz, not normalised.
        log_scales: [N, 3] of world units.
        opacity_logits: [N].
        sh_dc: [N, 3] colour coefficient of degree 0.
        sh_rest: [N, (degree + 1)^2 - 1, 3] of the higher degrees.
        active_degree: degree in use; the higher coefficients wait, and get no gradient.
        unit: the scene's unit of length in world units.
    """

    def __init__(
        self,
        means: Tensor,
        log_scales: Tensor,
        colors: Tensor,
        *,
        degree: int = 3,
        unit: float = 1.0,
        opacity: float = INITIAL_OPACITY,
    ) -> None:
        """Round Gaussians of one opacity: means [N, 3], log-scales [N, 3], RGB in [0, 1] [N, 3].

        Raises:
            ValueError: the degree is not 0, 1, 2 or 3.
        """
        super().__init__()
        if not 0 <= degree <= spherical_harmonics.MAX_DEGREE:
            raise ValueError(f"sh_degree is {degree}; it must be 0 to {spherical_harmonics.MAX_DEGREE}")
        count = len(means)
        self.degree, self.active_degree, self.unit = degree, 0, unit
        self.means = nn.Parameter(means.clone())
        self.quats = nn.Parameter(means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1))
        self.log_scales = nn.Parameter(log_scales.clone())
        self.opacity_logits = nn.Parameter(means.new_full((count,), math.log(opacity / (1 - opacity))))
        self.sh_dc = nn.Parameter(spherical_harmonics.dc_from_colors(colors.clamp(min=DARKEST)))
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
        """One Gaussian per point of the cloud; a random choice of points where there are more than `max_gaussians`.

        Args:
            scene: its cloud, and its unit.
            degree: of the spherical harmonics.
            max_gaussians: as many as there are at most; None: all.
            opacity: of all.
            scale: times `initial_scales`.
            generator: of the random choice, on the CPU.

        Raises:
            ValueError: the point cloud is empty or not finite.
        """
        points, colors = scene.points.float(), scene.point_colors.float() / 255
        refuse_unusable(points, "Gaussians")
        if max_gaussians is not None and len(points) > max_gaussians:
            chosen = torch.randperm(len(points), generator=generator)[:max_gaussians].sort().values
            points, colors = points[chosen], colors[chosen]
        log_scales = torch.log(scale * initial_scales(points, scene.scale))[:, None].repeat(1, 3)
        return cls(points, log_scales, colors, degree=degree, unit=scene.scale, opacity=opacity)

    def __len__(self) -> int:
        return len(self.means)

    def rows(self) -> dict[str, nn.Parameter]:
        """All parameters; each has one row per Gaussian."""
        return dict(self.named_parameters())

    def truncate(self, degree: int) -> None:
        """Leave out the harmonics above a degree; no optimizer may hold them."""
        self.degree, self.active_degree = degree, min(degree, self.active_degree)
        self.sh_rest.data, self.sh_rest.grad = self.sh_rest.data[:, : (degree + 1) ** 2 - 1].contiguous(), None

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what `state_dict` of another model gave; the number of Gaussians may differ.

        Raises:
            ValueError: as `padgs.training.optimizer.load_rows` does.
        """
        load_rows(self, tensors, self.rows())

    def gaussians(self, view: View) -> Gaussians:
        """The Gaussians with the colours that this view sees."""
        return self.probed(view)[0]

    def probed(self, view: View, probe: Tensor | None = None) -> tuple[Gaussians, Tensor | None]:
        """The same, moved by a probe [N, 3] along the world's axes, in halves of the distance from the camera.

        Of a probe [N, 4] the last values, in the same unit, are returned, too, [N]: see `padgs.methods.splats.probes`.
        """
        center, tiny = view.center.to(self.means), TINY * self.unit
        for native in (cpu_splats, gpu_splats):
            if native.fits(self.means, center):
                learned = (self.means, self.log_scales, self.opacity_logits, self.sh_dc, self.sh_rest)
                seen = native.native_splats(cpu_splats.Learned(*learned, probe), self.active_degree, center, tiny)
                return Gaussians(seen.means, self.quats, seen.scales, seen.opacities, seen.colors), seen.pulls
        means, pulls = self.means, None
        if probe is not None:
            steps = 0.5 * (means.detach() - center).norm(dim=-1, keepdim=True) * probe
            means, pulls = means + steps[:, :3], steps[:, 3] if steps.shape[1] > 3 else None
        opacities, colors = torch.sigmoid(self.opacity_logits), self._colors(means, center, tiny)
        return Gaussians(means, self.quats, torch.exp(self.log_scales), opacities, colors), pulls

    def _colors(self, means: Tensor, center: Tensor, tiny: float) -> Tensor:
        """Max(0, 1/2 + SH), [N, 3], seen along camera -> Gaussian in the world frame."""
        colors = 0.5 + spherical_harmonics.DC * self.sh_dc
        if self.active_degree > 0:
            rays = means - center
            directions = rays / torch.sqrt((rays * rays).sum(-1, keepdim=True) + tiny**2)
            values = spherical_harmonics.basis(directions, self.active_degree)[:, 1:]  # [N, K]
            # No einsum, which on a GPU is a tiny matrix product for each Gaussian.
            colors = colors + (values[..., None] * self.sh_rest[:, : values.shape[1]]).sum(1)
        return colors.clamp(min=0)


def initial_scales(points: Tensor, unit: float) -> Tensor:
    """Root mean square distance [N] of each point [N, 3] to its three nearest others, at least `SMALLEST_SCALE` units.

    A lone point gets a tenth of a unit.
    """
    squared = squared_spacing(points)
    if squared is None:
        return points.new_full((len(points),), 0.1 * unit)
    return squared.sqrt().clamp(min=SMALLEST_SCALE * unit).to(points)
