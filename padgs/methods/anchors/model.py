"""PaD-GS: anchors, and the Gaussians that they become as seen from a camera (paper Eq. 13-15)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from padgs.checks import check, check_known
from padgs.gaussians import Gaussians
from padgs.geometry.distortion import OMEGA_AXES, distortion, opacity_factor, polar_axis
from padgs.methods.anchors.decoder import Decoder, SeenAnchors, decode_gaussians, decode_within, decodes_within
from padgs.methods.anchors.grid import anchors_from_points, automatic_voxel_size, initial_log_scales
from padgs.methods.anchors.precision import PRECISIONS
from padgs.native.cuda import HostCopy
from padgs.scene import Scene, View
from padgs.training.optimizer import load_rows

OMEGA_INPUTS = ("sin2", "cos")
DISTANCE_UNITS = ("scene", "world")
TINY = 1e-6  # scene units; keeps directions finite for a camera exactly on an anchor


@dataclass(frozen=True)
class PaDGSOptions:
    """The model. The defaults are the paper as written; conf/method/padgs_release.yaml is its released code."""

    features: int = 32  # C, learned values per anchor
    offsets: int = 10  # K, Gaussians per anchor
    hidden: int = 32  # width of the hidden layer of each network
    precision: str = "float32"  # of the networks' products: float32, or bfloat16 or float16, which are for GPUs
    tau: float = 0.9  # Eq. 15; 0 turns opacity modulation off
    use_distance: bool = True  # distance camera - anchor as network input
    use_distortion: bool = True  # distortion degree as network input (DAGD)
    omega_axis: str = "camera_y"  # the latitude's axis: camera_y | world_z
    omega_input: str = "sin2"  # what the networks see: sin2 = Omega | cos = sqrt(1 - Omega)
    max_modulated_omega: float = 1.0  # limit of Omega in Eq. 15
    distance_unit: str = "scene"  # distances as input are in Scene.scale, or in units of the world
    voxel_size: float | str = "auto"  # world units, as the paper states it for its data sets; auto: `voxel_pixels`
    voxel_pixels: float = 0.1  # ... at the median depth, with voxel_size auto: below a pixel, as the paper's voxels are

    def __post_init__(self) -> None:
        check_known(self, omega_axis=OMEGA_AXES, omega_input=OMEGA_INPUTS)
        check_known(self, distance_unit=DISTANCE_UNITS, precision=PRECISIONS)
        check(self, "at least 1", lambda count: count >= 1, "features", "offsets", "hidden")
        check(self, "in [0, 1], or opacities turn negative at the poles", lambda tau: 0 <= tau <= 1, "tau")
        check(self, "> 0 and finite", lambda pixels: 0 < pixels < math.inf, "voxel_pixels")
        if isinstance(self.voxel_size, str) and self.voxel_size != "auto":
            raise ValueError(f"unknown voxel_size {self.voxel_size!r}; known: auto, or a length in world units")
        rule = "a length > 0 in world units, or auto"
        check(self, rule, lambda size: size == "auto" or 0 < size < math.inf, "voxel_size")

    @property
    def inputs(self) -> int:
        """Number of network inputs: features, direction 3, distance, distortion; 37 in the paper."""
        return self.features + 3 + self.use_distance + self.use_distortion


@dataclass(frozen=True)
class Decoded:
    """What the model shows to one camera: N selected of the A K Gaussians."""

    gaussians: Gaussians  # N, opacities modulated
    slots: Tensor  # [N] int64 ascending, anchor K + k
    raw_opacities: Tensor  # [A, K] in (-1, 1), before selection and modulation
    counted: HostCopy | None = None  # N, where `gaussians` and `slots` have rows for another number, see `PaDGS.decode`

    def count(self) -> int:
        """N; waits for it if it is not there yet."""
        return len(self.slots) if self.counted is None else self.counted.values()[0]


class PaDGS(nn.Module):
    """Anchors with K Gaussians each. Positions are a buffer: they are never learned and carry no gradient.

    Attributes:
        positions: [A, 3] world.
        features: [A, C].
        offsets: [A, K, 3] in units of the anchor's scale.
        log_scales: [A, 6]; the first three scale the offsets, the last three the Gaussians; world units.
        decoder: the networks.
        voxel_size: spacing of the grid that anchors live on, world units.
        unit: what distances are divided by before the networks see them, world units.
    """

    positions: Tensor

    def __init__(
        self,
        positions: Tensor,
        log_scales: Tensor,
        options: PaDGSOptions = PaDGSOptions(),
        *,
        voxel_size: float,
        unit: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> None:
        """A model with all Gaussians on their anchors [A, 3], log-scales [A, 6], and random networks."""
        super().__init__()
        count = len(positions)
        self.options, self.voxel_size, self.unit = options, voxel_size, unit
        self.register_buffer("positions", positions)
        self.features = nn.Parameter(positions.new_zeros(count, options.features))
        self.offsets = nn.Parameter(positions.new_zeros(count, options.offsets, 3))
        self.log_scales = nn.Parameter(log_scales)
        decoder = Decoder(options.inputs, options.offsets, options.hidden, generator=generator)
        self.decoder = decoder.to(positions.device)

    @classmethod
    def from_scene(cls, scene: Scene, options: PaDGSOptions = PaDGSOptions(), *, seed: int = 0) -> PaDGS:
        """The untrained model of a scene: its point cloud on a grid.

        Raises:
            ValueError: the point cloud is empty or not finite.
        """
        automatic = automatic_voxel_size(scene, options.voxel_pixels)
        voxel_size = automatic if options.voxel_size == "auto" else float(options.voxel_size)
        positions = anchors_from_points(scene.points, voxel_size)
        return cls(
            positions,
            initial_log_scales(positions, voxel_size),
            options,
            voxel_size=voxel_size,
            unit=scene.scale if options.distance_unit == "scene" else 1.0,
            generator=torch.Generator().manual_seed(seed),
        )

    def __len__(self) -> int:
        return len(self.positions)

    def rows(self) -> dict[str, nn.Parameter]:
        """The parameters that have one row per anchor."""
        return {"offsets": self.offsets, "features": self.features, "log_scales": self.log_scales}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what `state_dict` of another model gave; the number of anchors may differ.

        Raises:
            ValueError: as `padgs.training.optimizer.load_rows` does.
        """
        load_rows(self, tensors, ("positions", *self.rows()))
        self.positions = tensors["positions"].to(self.positions).clone()

    @torch.no_grad()
    def centers(self) -> Tensor:
        """Means [A K, 3] of all Gaussians in the world frame, selected or not, without gradient (Eq. 14)."""
        reach = torch.exp(self.log_scales[:, None, :3])
        return (self.positions[:, None] + reach * self.offsets).view(-1, 3)

    @torch.no_grad()
    def seen_from(self, view: View) -> tuple[Tensor, Tensor, Tensor]:
        """Anchors as a camera sees them; constants of the view, so without gradient.

        Returns:
            direction [A, 3] camera -> anchor in the world frame; distance [A] in `unit`; distortion degree Omega [A].
        """
        ray = self.positions - view.center.to(self.positions)
        distance = torch.sqrt((ray * ray).sum(-1) + (TINY * self.unit) ** 2)
        direction = ray / distance[:, None]
        axis = polar_axis(self.options.omega_axis, view.cam_from_world.to(self.positions))
        return direction, distance / self.unit, distortion(direction, axis)

    def decode(self, view: View, room: int | None = None) -> Decoded:
        """The Gaussians that this view shows (Eq. 13-15).

        Args:
            view: from where.
            room: on a GPU, decode so many rows without waiting for N: zeros, which nobody draws, are behind the N, and
                if there are fewer rows than N, the last are missing. Elsewhere, and with None, there are N.
        """
        weights, anchors, precision = self.decoder.weights(), self.as_seen(view), self.options.precision
        if room is None or not decodes_within(anchors, precision):
            return Decoded(*decode_gaussians(weights, anchors, precision))
        gaussians, slots, raw_opacities, count = decode_within(weights, anchors, room, precision)
        return Decoded(gaussians, slots, raw_opacities, HostCopy(count))

    def show(self, view: View) -> Gaussians:
        """The same for `padgs.render.backends.captured`: A K Gaussians, of which those that are not selected are zeros.

        Raises:
            ValueError, OSError: as `padgs.methods.anchors.decoder.decode_within` does.
        """
        everything = self.offsets[..., 0].numel()
        return decode_within(self.decoder.weights(), self.as_seen(view), everything, self.options.precision)[0]

    def as_seen(self, view: View) -> SeenAnchors:
        """What is decoded."""
        options = self.options
        direction, distance, omega = self.seen_from(view)
        seen = [direction]
        if options.use_distance:
            seen.append(distance[:, None])
        if options.use_distortion:
            seen_omega = omega if options.omega_input == "sin2" else torch.sqrt((1 - omega).clamp(min=0))
            seen.append(seen_omega[:, None])
        attenuation = opacity_factor(omega, options.tau, options.max_modulated_omega)
        seen = torch.cat(seen, dim=-1)
        return SeenAnchors(self.features, seen, self.positions, self.offsets, self.log_scales, attenuation)
