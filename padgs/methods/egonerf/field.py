"""EgoNeRF's radiance field: density and appearance grids, shading, environment map, and volume rendering of rays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from padgs.checks import check, check_known
from padgs.methods.egonerf import grids
from padgs.methods.egonerf.grids import Factors, GridPosition, PlaneLines
from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.training.initial_points import refuse_unusable

CLOUD_SHARE = 0.95  # of the points; those behind may be outliers
MAX_ROOM_REACH = 4.0  # scene units
FREQUENCIES = 2  # of the positional encoding of features and directions


class Constants(NamedTuple):
    """Constants whose published values differ between indoor and outdoor scenes."""

    density_shift: float  # density = softplus(feature + shift)
    distance_scale: float  # optical depth = density x scale x length
    near: float
    far: float
    first_radius: float  # of the radial nodes, and the shortest interval between nodes or coarse samples
    environment: bool  # environment map as background; else black

    def in_units_of(self, unit: float) -> Constants:
        """Return the constants with lengths in units of `unit`."""
        near, far, first_radius = self.near / unit, self.far / unit, self.first_radius / unit
        return self._replace(distance_scale=self.distance_scale * unit, near=near, far=far, first_radius=first_radius)


# World units of Ricoh360 and of the rooms of OmniBlender; ours: the scene scale of such scenes.
PUBLISHED = {
    "outdoor": (Constants(-10.0, 25.0, 0.1, 300.0, 0.05, True), 5.0),
    "indoor": (Constants(-8.0, 25.0, 0.01, 15.0, 0.03, False), 2.5),
}


@dataclass(frozen=True)
class EgoNeRFOptions:
    """The model and its training as published for Ricoh360. Lengths are in scene scales; None: published value."""

    radial_nodes: int = 150  # radial nodes of each chart
    polar_nodes: int = 172  # polar nodes of each chart
    azimuth_nodes: int = 516  # azimuth nodes of each chart
    density_components: int = 16  # components of the density for each mode
    appearance_components: int = 48  # components of the appearance for each mode
    features: int = 27  # appearance features of the basis
    hidden: int = 128  # width of the two hidden layers
    coarse_samples: int = 128  # samples of each ray before importance sampling
    fine_samples: int = 128  # importance samples of each ray
    min_weight: float = 0.0  # ours: samples with smaller weights are not shaded but black
    surroundings: str = "auto"  # indoor | outdoor | auto: by the cloud, see `surroundings_of`
    near: float | None = None  # distance of the first sample
    far: float | None = None  # distance of the last sample
    first_radius: float | None = None  # radius of the first node, and shortest interval between nodes or samples
    environment_height: int = 1920  # rows of the environment map; twice as many columns
    samples_at_once: int = 1 << 18  # ours: bounds the memory of a pass, in training and rendering
    rays: int = 4096  # rays of an iteration
    density_variation: float = 0.1  # weight of the total variation of the density planes; 0: none
    appearance_variation: float = 0.01  # weight of the total variation of the appearance planes

    def __post_init__(self) -> None:
        check_known(self, surroundings=("auto", *PUBLISHED))
        nodes = ("radial_nodes", "polar_nodes", "azimuth_nodes")
        check(self, "even, for the coarse grid halves it, and at least 4", lambda n: n >= 4 and n % 2 == 0, *nodes)
        sizes = ("density_components", "appearance_components", "features", "hidden", "environment_height", "rays")
        check(self, "at least 1", lambda size: size >= 1, *sizes)
        if self.coarse_samples < 4 or self.fine_samples < 1:
            given = f"coarse_samples is {self.coarse_samples} and fine_samples {self.fine_samples}"
            raise ValueError(f"{given}; they must be at least 4 and 1")
        check(self, ">= 0", lambda weight: weight >= 0, "density_variation", "appearance_variation")
        for surroundings in PUBLISHED if self.surroundings == "auto" else (self.surroundings,):
            constants = self.constants(surroundings)
            near, far, first_radius = constants.near, constants.far, constants.first_radius
            if not 0 < first_radius < far - near or not near > 0:
                raise ValueError(
                    f"near is {near}, far {far} and first_radius {first_radius}; near and first_radius must be > 0, "
                    "and far - near larger than first_radius"
                )
        check(self, "in [0, 1)", lambda weight: 0 <= weight < 1, "min_weight")
        if self.samples_at_once < self.samples:
            raise ValueError(f"samples_at_once is {self.samples_at_once}, and a ray has {self.samples}; raise it")

    def constants(self, surroundings: str) -> Constants:
        """Return the constants for indoor or outdoor; given values replace published ones."""
        published, unit = PUBLISHED[surroundings]
        given = {name: v for name in ("near", "far", "first_radius") if (v := getattr(self, name)) is not None}
        return published.in_units_of(unit)._replace(**given)

    @property
    def samples(self) -> int:
        """Shaded samples of a ray."""
        return self.coarse_samples + self.fine_samples

    @property
    def rays_at_once(self) -> int:
        """Rays in one pass."""
        return self.samples_at_once // self.samples


class RayColors(NamedTuple):
    """Results of B rays."""

    color: Tensor  # [B, 3]
    transmittance: Tensor  # [B]
    depth: Tensor  # [B] model units: mean distance weighted by contribution; 0 where nothing contributes


class EgoNeRF(nn.Module):
    """The radiance field. Internal positions are (world - centre) / unit.

    `centre` [3] float64 is the mean camera position in the world, `unit` are world units per unit of the model,
    `travel` is the largest distance of a camera from the centre, model units; grids reach `far` beyond it. `kind` are
    the surroundings, indoor or outdoor, with their `constants`, or given ones.
    """

    centre: Tensor

    def __init__(self, options: EgoNeRFOptions, centre: Tensor, unit: float, travel: float, kind: str) -> None:
        """Build grids of noise from torch's global random state."""
        super().__init__()
        self.options, self.unit, self.travel, self.kind = options, unit, travel, kind
        self.constants = constants = options.constants(kind)
        self.register_buffer("centre", centre.double(), persistent=False)
        shape = {"radius": options.radial_nodes, "polar": options.polar_nodes, "azimuth": options.azimuth_nodes}
        self.density = PlaneLines(options.density_components, shape)
        self.appearance = PlaneLines(options.appearance_components, shape)
        self.shader = Shader(options)
        self.environment = EnvironmentMap(options.environment_height) if constants.environment else None
        # Half the diagonal of a cube around the reach of all rays, as published.
        reach = math.sqrt(3) * (travel + constants.far)
        first, samples = constants.first_radius, options.coarse_samples
        nodes = grids.exponential_nodes(first, reach, options.radial_nodes)
        self.register_buffer("nodes", nodes.float(), persistent=False)
        distances = constants.near + grids.exponential_nodes(first, constants.far - constants.near, samples)
        self.register_buffer("distances", distances.float(), persistent=False)

    @classmethod
    def from_scene(cls, scene: Scene, options: EgoNeRFOptions, seed: int = 0) -> EgoNeRF:
        """Return an untrained model around the mean training camera, on the device of the scene's points."""
        unit = scene.scale
        centers = torch.stack([view.center for view in scene.train]).double().cpu()
        centre = centers.mean(0)
        travel = (centers - centre).norm(dim=-1).max().item() / unit
        kind = surroundings_of(scene) if options.surroundings == "auto" else options.surroundings
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            model = cls(options, centre, unit, travel, kind)
        return model.to(scene.points.device)

    def trace(self, origins: Tensor, directions: Tensor, generator: torch.Generator | None = None) -> RayColors:
        """Render rays from origins [B, 3], model units, along unit directions [B, 3]; `generator` jitters samples."""
        distances = self._sample(origins, directions, generator)
        at = self._at(origins, directions, distances)
        depths = self._optical_depths(self.density.factors(), at, distances)
        weights, residual = grids.visible_shares(depths)
        color = self._shade(at, directions, weights)
        if self.environment is not None:
            color = color + residual[:, None] * self.environment(directions)
        contribution = weights.sum(-1)
        depth = (weights * distances).sum(-1) / contribution.clamp(min=torch.finfo(weights.dtype).tiny)
        return RayColors(color, residual, depth)

    @torch.no_grad()
    def render(self, view: View) -> Rendering:
        """Render a view with any camera, in passes of bounded memory."""
        camera, nodes = view.camera, self.get_buffer("nodes")
        rotation = view.cam_from_world[:3, :3].to(nodes)
        directions = camera.rays(dtype=nodes.dtype, device=nodes.device).reshape(-1, 3) @ rotation
        origin = self.from_world(view.center)
        passes = [self.trace(origin.expand_as(part), part) for part in directions.split(self.options.rays_at_once)]
        color, transmittance, depth = (torch.cat(parts) for parts in zip(*passes, strict=True))
        size = (view.height, view.width)
        return Rendering(
            color.view(*size, 3),
            transmittance.view(size),
            depth.view(size) * self.unit,
            torch.zeros(0, dtype=torch.bool, device=nodes.device),  # no Gaussians
            {"rays": len(directions), "samples": len(directions) * self.options.samples},
        )

    def from_world(self, points: Tensor) -> Tensor:
        """Return positions [..., 3], model units, of points in the world, on the model's device."""
        return ((points.to(self.centre) - self.centre) / self.unit).to(self.get_buffer("nodes"))

    @torch.no_grad()
    def _sample(self, origins: Tensor, directions: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return sample distances [B, coarse + fine], increasing."""
        count, coarse = self.options.fine_samples, self.get_buffer("distances")
        first = coarse.expand(len(origins), -1)
        within = coarse.new_full((len(origins), count), 0.5)  # position in each quantile
        if generator is not None:
            first = first + grids.interval_lengths(first) * torch.rand(first.shape, generator=generator).to(coarse)
            within = torch.rand(within.shape, generator=generator).to(coarse)
        at = self._at(origins, directions, first)
        weights, _ = grids.visible_shares(self._optical_depths(self.density.coarse(), at, first))
        second = grids.refined(first, weights, (torch.arange(count, device=coarse.device).to(coarse) + within) / count)
        return torch.cat((first, second), dim=-1).sort(dim=-1).values

    def _at(self, origins: Tensor, directions: Tensor, distances: Tensor) -> GridPosition:
        points = origins[:, None] + distances[..., None] * directions[:, None]
        return grids.grid_position(points.reshape(-1, 3), self.get_buffer("nodes"))

    def _optical_depths(self, factors: Factors, at: GridPosition, distances: Tensor) -> Tensor:
        feature = grids.density_feature(factors, at).view(distances.shape)
        density = functional.softplus(feature + self.constants.density_shift)
        return density * grids.interval_lengths(distances) * self.constants.distance_scale

    def _shade(self, at: GridPosition, directions: Tensor, weights: Tensor) -> Tensor:
        """Return colours [B, 3], summed over samples."""
        rays, samples = weights.shape
        counts = (weights.detach().reshape(-1) >= self.options.min_weight).nonzero().squeeze(-1)
        ray = counts // samples
        at = GridPosition(*(values[counts] for values in at))
        color = self.shader(grids.products(self.appearance.factors(), at), at.chart, directions[ray])
        return color.new_zeros(rays, 3).index_add(0, ray, color * weights.reshape(-1)[counts, None])


class Shader(nn.Module):
    """Network from appearance features (a linear basis per chart) and direction to RGB in (0, 1)."""

    def __init__(self, options: EgoNeRFOptions) -> None:
        super().__init__()
        features, hidden = options.features, options.hidden
        inputs = len(grids.MODES) * options.appearance_components
        bound = 1 / math.sqrt(inputs)
        self.basis = nn.Parameter(torch.empty(grids.CHARTS, features, inputs).uniform_(-bound, bound))
        width = (features + 3) * (1 + 2 * FREQUENCIES)
        last = nn.Linear(hidden, 3)
        nn.init.zeros_(last.bias)
        layers = (nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.network = nn.Sequential(*layers, last, nn.Sigmoid())

    def forward(self, products: Sequence[Tensor], chart: Tensor, directions: Tensor) -> Tensor:
        """Return colours [N, 3] from `products`, charts [N] of the positions, and unit directions [N, 3]."""
        stacked = torch.cat(list(products))
        features = torch.where(chart == grids.YANG, self.basis[grids.YANG] @ stacked, self.basis[grids.YIN] @ stacked).T
        encoded = encoding(features, FREQUENCIES), encoding(directions, FREQUENCIES)
        return self.network(torch.cat(encoded, dim=-1))


def encoding(values: Tensor, frequencies: int) -> Tensor:
    """Return values [N, D] with sines and cosines of 1, 2, 4, ... times them, [N, D (1 + 2 frequencies)].

    >>> encoding(torch.zeros(1, 1), 2).tolist()
    [[0.0, 0.0, 0.0, 1.0, 1.0]]
    """
    factors = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = (values[..., None] * factors).flatten(-2)
    return torch.cat((values, angles.sin(), angles.cos()), dim=-1)


class EnvironmentMap(nn.Module):
    """Colours by direction, bilinear, through a sigmoid; all texels cover the same solid angle.

    Texel (i, j) of H x 2H is at z = (2 i + 1) / H - 1, azimuth ((2 j + 1) / 2H - 1) pi; continuous across the seam.
    """

    def __init__(self, height: int) -> None:
        """Build H rows, initially uniform in [0, 1) before the sigmoid."""
        super().__init__()
        self.emission = nn.Parameter(torch.rand(3, height, 2 * height))

    def forward(self, directions: Tensor) -> Tensor:
        """Return colours [N, 3] in (0, 1) of unit directions [N, 3]."""
        x, y, z = directions.unbind(-1)
        width = self.emission.shape[2]
        padded = torch.cat((self.emission[..., -1:], self.emission, self.emission[..., :1]), dim=-1)
        places = torch.stack((torch.atan2(y, x) / math.pi * (width / (width + 2)), z), dim=-1)[None, :, None]
        values = functional.grid_sample(padded[None], places, align_corners=False, padding_mode="border")
        return torch.sigmoid(values[0, :, :, 0].T)


def surroundings_of(scene: Scene) -> str:
    """Return indoor or outdoor, by the cloud: indoors nearly all points are about as far away as the median one.

    Ours. 95 % of the points were within 1.4 to 2.4 scene units in nine rooms (generated, scanned and reconstructed),
    within 5.7 in a garden and 41 in the generated outdoor scene. A random cloud looks like a room.
    """
    return "indoor" if cloud_reach(scene) <= MAX_ROOM_REACH else "outdoor"


def cloud_reach(scene: Scene) -> float:
    """Return the distance that `CLOUD_SHARE` of the points are within, scene units, median over training cameras."""
    refuse_unusable(scene.points, "the constants of EgoNeRF")
    points = scene.points[:: max(1, len(scene.points) // 20_000)].double()
    distances = [(points - view.center.to(points)).norm(dim=-1).quantile(CLOUD_SHARE) for view in scene.train]
    return torch.stack(distances).median().item() / scene.scale
