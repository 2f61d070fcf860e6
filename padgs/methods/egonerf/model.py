"""EgoNeRF: rays in, colours out."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from padgs.methods.egonerf import surroundings
from padgs.methods.egonerf.environment import EnvironmentMap
from padgs.methods.egonerf.options import EgoNeRFOptions
from padgs.methods.egonerf.plane_lines import (
    Factors,
    GridPosition,
    PlaneLines,
    density_feature,
    grid_position,
    products,
)
from padgs.methods.egonerf.radii import exponential_nodes
from padgs.methods.egonerf.ray_samples import interval_lengths, jittered, refined, visible_shares
from padgs.methods.egonerf.shading import Shader
from padgs.render import Rendering
from padgs.scene import Scene, View


class RayColors(NamedTuple):
    """What B rays see."""

    color: Tensor  # [B, 3]
    transmittance: Tensor  # [B], what is left for the environment
    depth: Tensor  # [B] model units: mean distance weighted by contribution; 0 where nothing contributes


class EgoNeRF(nn.Module):
    """The radiance field. Positions inside are (world - centre) / unit.

    Attributes:
        centre: [3] float64, mean camera position in the world.
        unit: world units to one unit of the model.
        travel: how far cameras get from the centre, in units of the model; the grids reach `far` beyond it.
        kind: of the surroundings, indoor or outdoor.
        constants: theirs, or given.
    """

    centre: Tensor

    def __init__(self, options: EgoNeRFOptions, centre: Tensor, unit: float, travel: float, kind: str) -> None:
        """Grids of noise; random numbers are torch's own."""
        super().__init__()
        self.options, self.unit, self.travel, self.kind = options, unit, travel, kind
        self.constants = constants = options.constants(kind)
        self.register_buffer("centre", centre.double(), persistent=False)
        shape = {"radius": options.radial_nodes, "polar": options.polar_nodes, "azimuth": options.azimuth_nodes}
        self.density = PlaneLines(options.density_components, shape)
        self.appearance = PlaneLines(options.appearance_components, shape)
        self.shader = Shader(options)
        self.environment = EnvironmentMap(options.environment_height) if constants.environment else None
        # Half the diagonal of a cube around all that rays can reach, as published.
        reach = math.sqrt(3) * (travel + constants.far)
        first, samples = constants.first_radius, options.coarse_samples
        self.register_buffer("nodes", exponential_nodes(first, reach, options.radial_nodes).float(), persistent=False)
        distances = constants.near + exponential_nodes(first, constants.far - constants.near, samples)
        self.register_buffer("distances", distances.float(), persistent=False)

    @classmethod
    def from_scene(cls, scene: Scene, options: EgoNeRFOptions, seed: int = 0) -> EgoNeRF:
        """An untrained model around the mean of the training cameras, on the device of the scene's points."""
        unit = scene.scale if options.length_unit == "scene" else 1.0
        centers = torch.stack([view.center for view in scene.train]).double().cpu()
        centre = centers.mean(0)
        travel = (centers - centre).norm(dim=-1).max().item() / unit
        kind = surroundings.of_scene(scene) if options.surroundings == "auto" else options.surroundings
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            model = cls(options, centre, unit, travel, kind)
        return model.to(scene.points.device)

    def trace(self, origins: Tensor, directions: Tensor, generator: torch.Generator | None = None) -> RayColors:
        """Colours of rays, differentiable by the parameters.

        Args:
            origins: [B, 3] in units of the model.
            directions: [B, 3] unit.
            generator: jitters the samples, in training; without one they lie where they lie.
        """
        distances = self._sample(origins, directions, generator)
        at = self._at(origins, directions, distances)
        depths = self._optical_depths(self.density.factors(), at, distances)
        weights, residual = visible_shares(depths)
        color = self._shade(at, directions, weights)
        if self.environment is not None:
            color = color + residual[:, None] * self.environment(directions)
        contribution = weights.sum(-1)
        depth = (weights * distances).sum(-1) / contribution.clamp(min=torch.finfo(weights.dtype).tiny)
        return RayColors(color, residual, depth)

    @torch.no_grad()
    def render(self, view: View) -> Rendering:
        """An image of a view with any camera, in passes of bounded memory."""
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
            torch.zeros(0, dtype=torch.bool, device=nodes.device),  # there are no Gaussians to be seen
            {"rays": len(directions), "samples": len(directions) * self.options.samples},
        )

    def from_world(self, points: Tensor) -> Tensor:
        """Positions [..., 3] in units of the model of points in the world, on the model's device."""
        return ((points.to(self.centre) - self.centre) / self.unit).to(self.get_buffer("nodes"))

    @torch.no_grad()
    def _sample(self, origins: Tensor, directions: Tensor, generator: torch.Generator | None) -> Tensor:
        """Distances [B, coarse + fine], increasing."""
        count, coarse = self.options.fine_samples, self.get_buffer("distances")
        first = coarse.expand(len(origins), -1)
        within = coarse.new_full((len(origins), count), 0.5)  # which place of each quantile
        if generator is not None:
            first = jittered(first, torch.rand(first.shape, generator=generator).to(coarse))
            within = torch.rand(within.shape, generator=generator).to(coarse)
        at = self._at(origins, directions, first)
        weights, _ = visible_shares(self._optical_depths(self.density.coarse(), at, first))
        second = refined(first, weights, (torch.arange(count, device=coarse.device).to(coarse) + within) / count)
        return torch.cat((first, second), dim=-1).sort(dim=-1).values

    def _at(self, origins: Tensor, directions: Tensor, distances: Tensor) -> GridPosition:
        points = origins[:, None] + distances[..., None] * directions[:, None]
        return grid_position(points.reshape(-1, 3), self.get_buffer("nodes"))

    def _optical_depths(self, factors: Factors, at: GridPosition, distances: Tensor) -> Tensor:
        feature = density_feature(factors, at).view(distances.shape)
        density = functional.softplus(feature + self.constants.density_shift)
        return density * interval_lengths(distances) * self.constants.distance_scale

    def _shade(self, at: GridPosition, directions: Tensor, weights: Tensor) -> Tensor:
        """Colours [B, 3] of all samples together."""
        rays, samples = weights.shape
        counts = (weights.detach().reshape(-1) >= self.options.min_weight).nonzero().squeeze(-1)
        ray = counts // samples
        at = at.where(counts)
        color = self.shader(products(self.appearance.factors(), at), at.chart, directions[ray])
        return color.new_zeros(rays, 3).index_add(0, ray, color * weights.reshape(-1)[counts, None])
