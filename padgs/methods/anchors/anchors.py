"""PaD-GS: anchors on a grid, and the Gaussians that they become as seen from a camera (paper Eq. 13-15).

An anchor sits on a vertex of a grid of spacing `voxel_size`, so three integers, its cell, identify it exactly. Anchors
are compared by cells, never by floating-point positions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from padgs.checks import check, check_known
from padgs.gaussians import Gaussians
from padgs.geometry.distortion import OMEGA_AXES, distortion, opacity_factor, polar_axis
from padgs.methods.anchors.decoder import Decoder, SeenAnchors, decode_gaussians
from padgs.native.cuda import HostCopy
from padgs.scene import Scene, View
from padgs.training.initial_points import refuse_unusable, squared_spacing
from padgs.training.optimizer import load_rows

MOST_CELLS = 2**53  # from the origin; float64, which rounds positions to cells, counts so far
TINY = 1e-6  # scene units; keeps directions finite for a camera exactly on an anchor


@dataclass(frozen=True)
class PaDGSOptions:
    """The model. Defaults are the paper as written; conf/method/padgs_release.yaml is the released code."""

    features: int = 32  # C, learned features per anchor
    offsets: int = 10  # K, Gaussians per anchor
    hidden: int = 32  # width of the hidden layer of each network
    tau: float = 0.9  # Eq. 15; 0 turns opacity modulation off
    use_distance: bool = True  # distance camera - anchor as network input
    use_distortion: bool = True  # distortion degree as network input (DAGD)
    omega_axis: str = "camera_y"  # axis of the latitude: camera_y | world_z
    omega_input: str = "sin2"  # network input: sin2 = Omega | cos = sqrt(1 - Omega)
    max_modulated_omega: float = 1.0  # upper limit of Omega in Eq. 15
    distance_unit: str = "scene"  # unit of the distance input: scene (`Scene.scale`) | world
    voxel_size: float | str = "auto"  # world units, as the paper states it per data set; auto: by `voxel_pixels`
    voxel_pixels: float = 0.1  # voxel_size=auto: pixels at the median depth; below 1 like the paper's voxels

    def __post_init__(self) -> None:
        check_known(self, omega_axis=OMEGA_AXES, omega_input=("sin2", "cos"), distance_unit=("scene", "world"))
        check(self, "at least 1", lambda count: count >= 1, "features", "offsets", "hidden")
        check(self, "in [0, 1]", lambda limit: 0 <= limit <= 1, "max_modulated_omega")
        check(self, "in [0, 1], or opacities turn negative at the poles", lambda tau: 0 <= tau <= 1, "tau")
        check(self, "> 0 and finite", lambda pixels: 0 < pixels < math.inf, "voxel_pixels")
        if isinstance(self.voxel_size, str) and self.voxel_size != "auto":
            raise ValueError(f"unknown voxel_size {self.voxel_size!r}; known: auto, or a length in world units")
        rule = "a length > 0 in world units, or auto"
        check(self, rule, lambda size: size == "auto" or 0 < size < math.inf, "voxel_size")
        if self.voxel_size != "auto" and self.voxel_pixels != PaDGSOptions.voxel_pixels:
            raise ValueError(
                f"voxel_pixels is {self.voxel_pixels}, but voxel_size is {self.voxel_size} world units; set "
                f"voxel_size=auto or voxel_pixels={PaDGSOptions.voxel_pixels}"
            )

    @property
    def inputs(self) -> int:
        """Number of network inputs: features, direction (3), distance, distortion; 37 in the paper."""
        return self.features + 3 + self.use_distance + self.use_distortion


@dataclass(frozen=True)
class Decoded:
    """Gaussians decoded for one camera: N selected of A K."""

    gaussians: Gaussians  # N, opacities modulated
    slots: Tensor  # [N] int64 ascending, anchor K + k
    raw_opacities: Tensor  # [A, K] in (-1, 1), before selection and modulation
    selected: HostCopy | None = None  # N, if `gaussians` and `slots` have another number of rows, see `PaDGS.decode`

    def count(self) -> int:
        """Return N; waits for the GPU if necessary."""
        return len(self.slots) if self.selected is None else self.selected.values()[0]


class PaDGS(nn.Module):
    """A anchors with K Gaussians each. Positions are a buffer: they are not learned.

    Attributes:
        positions: [A, 3] world.
        features: [A, C].
        offsets: [A, K, 3] in units of the anchor's scale.
        log_scales: [A, 6]; the first three scale the offsets, the last three the Gaussians; in `unit`.
        decoder: three networks.
        voxel_size: spacing of the grid that anchors live on, world units.
        scene_scale: `Scene.scale`, world units.
        unit: world units of the log-scales; a power of two, so that worlds that differ by one train alike, bit by bit.
        axis: mean polar axis of the training panoramas, for cameras that have none of their own; None: their y axis.
    """

    positions: Tensor

    def __init__(
        self,
        positions: Tensor,
        log_scales: Tensor,
        options: PaDGSOptions = PaDGSOptions(),
        *,
        voxel_size: float,
        scene_scale: float = 1.0,
        unit: float = 1.0,
        axis: Sequence[float] | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        """Build an untrained model: Gaussians at their anchors [A, 3], log-scales [A, 6], random networks."""
        super().__init__()
        count = len(positions)
        self.options, self.voxel_size, self.scene_scale, self.unit = options, voxel_size, scene_scale, unit
        self.axis = axis
        self.register_buffer("positions", positions)
        self.features = nn.Parameter(positions.new_zeros(count, options.features))
        self.offsets = nn.Parameter(positions.new_zeros(count, options.offsets, 3))
        self.log_scales = nn.Parameter(log_scales)
        decoder = Decoder(options.inputs, options.offsets, options.hidden, generator=generator)
        self.decoder = decoder.to(positions.device)

    @classmethod
    def from_scene(cls, scene: Scene, options: PaDGSOptions = PaDGSOptions(), *, seed: int = 0) -> PaDGS:
        """Return the untrained model of a scene: its point cloud on a grid."""
        automatic = options.voxel_pixels * math.pi / max(view.height for view in scene.panoramas) * scene.scale
        voxel_size = automatic if options.voxel_size == "auto" else float(options.voxel_size)
        positions = anchors_from_points(scene.points, voxel_size)
        in_world = options.distance_unit == "world"
        unit = 1.0 if in_world else 2.0 ** round(math.log2(scene.scale))
        return cls(
            positions,
            initial_log_scales(positions / unit, voxel_size / unit),
            options,
            voxel_size=voxel_size,
            scene_scale=scene.scale,
            unit=unit,
            axis=mean_axis(scene),
            generator=torch.Generator().manual_seed(seed),
        )

    def __len__(self) -> int:
        return len(self.positions)

    def rows(self) -> dict[str, nn.Parameter]:
        """Return the parameters with one row per anchor."""
        return {"offsets": self.offsets, "features": self.features, "log_scales": self.log_scales}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Copy the `state_dict` of another model, whose number of anchors may differ."""
        load_rows(self, tensors, ("positions", *self.rows()))
        self.positions = tensors["positions"].to(self.positions).clone()

    @torch.no_grad()
    def centers(self) -> Tensor:
        """Return the means [A K, 3] of all Gaussians, selected or not, world frame, without gradient (Eq. 14)."""
        reach = self.unit * torch.exp(self.log_scales[:, None, :3])
        return (self.positions[:, None] + reach * self.offsets).view(-1, 3)

    @torch.no_grad()
    def seen_from(self, view: View) -> tuple[Tensor, Tensor, Tensor]:
        """Return direction [A, 3] camera -> anchor in the world, distance [A] in `distance_unit`, distortion [A]."""
        ray = self.positions - view.center.to(self.positions)
        unit = 1.0 if self.options.distance_unit == "world" else self.scene_scale
        distance = torch.sqrt((ray * ray).sum(-1) + (TINY * unit) ** 2)
        direction = ray / distance[:, None]
        axis = polar_axis(self.options.omega_axis, view.cam_from_world.to(self.positions))
        if view.camera.kind != "panorama" and self.axis is not None and self.options.omega_axis == "camera_y":
            axis = self.positions.new_tensor(self.axis)  # as panoramas of that place, whatever way the camera is turned
        return direction, distance / unit, distortion(direction, axis)

    def decode(self, view: View, capacity: int | None = None) -> Decoded:
        """Decode the Gaussians that a view sees (Eq. 13-15); `capacity` as in `decode_gaussians`."""
        options = self.options
        direction, distance, omega = self.seen_from(view)
        seen = [direction]
        if options.use_distance:
            seen.append(distance[:, None])
        if options.use_distortion:
            seen_omega = omega if options.omega_input == "sin2" else torch.sqrt((1 - omega).clamp(min=0))
            seen.append(seen_omega[:, None])
        attenuation = opacity_factor(omega, options.tau, options.max_modulated_omega)
        lengths = (self.positions / self.unit, self.offsets, self.log_scales)
        inputs = SeenAnchors(self.features, torch.cat(seen, dim=-1), *lengths, attenuation)
        gaussians, slots, raw_opacities, count = decode_gaussians(self.decoder.weights(), inputs, capacity)
        if self.unit != 1:
            gaussians = replace(gaussians, means=self.unit * gaussians.means, scales=self.unit * gaussians.scales)
        return Decoded(gaussians, slots, raw_opacities, None if count is None else HostCopy(count))


def mean_axis(scene: Scene) -> list[float] | None:
    """Return the mean polar axis [3] of the training panoramas, a unit vector in the world; None for opposite ones."""
    mean = torch.stack([view.cam_from_world[1, :3].double() for view in scene.train if view.lens is None]).mean(0)
    return (mean / mean.norm()).tolist() if mean.norm() > 0.1 else None


def cells_from_points(points: Tensor, size: float) -> Tensor:
    """Return cells [N, 3] int64 of points [N, 3]: the nearest vertex of a grid of spacing `size`, halves to even."""
    return torch.round(points.double() / size).long()


def points_from_cells(cells: Tensor, size: float, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return vertices [N, 3] of a grid of spacing `size`; the inverse of `cells_from_points`."""
    return (cells.double() * size).to(dtype)


def cell_keys(cells: Tensor) -> Tensor:
    """Return one int64 per row of cells [N, 3], [N]: equal exactly for equal rows, in lexicographic order.

    A number with three digits, one per axis; or the slower rank among distinct rows if those exceed 64 bits.
    """
    if len(cells) == 0:
        return cells.new_zeros(0)
    digits = cells - cells.min(0).values
    if math.prod(side + 1 for side in digits.max(0).values.tolist()) >= 2**63:
        return torch.unique(cells, dim=0, return_inverse=True)[1]
    _, base_y, base_z = (digits.max(0).values + 1).unbind(-1)
    return (digits[:, 0] * base_y + digits[:, 1]) * base_z + digits[:, 2]


def unique_cells(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct rows [U, 3] of cells [N, 3] in lexicographic order, and the index of each input, [N]."""
    keys, inverse = torch.unique(cell_keys(cells), return_inverse=True)
    numbers = torch.arange(len(cells), device=cells.device)
    first = torch.full_like(keys, len(cells)).scatter_reduce(0, inverse, numbers, "amin")
    return cells[first], inverse


def occupied(cells: Tensor, by: Tensor) -> Tensor:
    """Return which cells [U, 3] occur among the cells `by` [N, 3], [U] bool; O((U + N) log(U + N))."""
    keys = cell_keys(torch.cat((cells, by)))
    return torch.isin(keys[: len(cells)], keys[len(cells) :])


def anchors_from_points(points: Tensor, voxel_size: float) -> Tensor:
    """Return anchor positions [A, 3] float32: the distinct grid vertices nearest to points [P, 3], world units.

    A ValueError says that the points are so many voxels away from the origin that cells are not exact.
    """
    refuse_unusable(points, "anchors")
    if (furthest := points.abs().max().item()) >= MOST_CELLS * voxel_size:
        raise ValueError(
            f"voxel_size is {voxel_size:g}, but points are {furthest:g} world units from the origin; it must be above "
            f"{furthest / MOST_CELLS:g}: increase method.voxel_size or method.voxel_pixels"
        )
    cells, _ = unique_cells(cells_from_points(points, voxel_size))
    return points_from_cells(cells, voxel_size)


def initial_log_scales(positions: Tensor, voxel_size: float) -> Tensor:
    """Return initial log-scales [A, 6] of anchors [A, 3]: the log RMS distance to three neighbours; a voxel for one."""
    squared = squared_spacing(positions)
    if squared is None:
        return positions.new_full((len(positions), 6), math.log(voxel_size))
    return (0.5 * torch.log(squared)).to(positions)[:, None].repeat(1, 6)
