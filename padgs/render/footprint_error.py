"""How far each projection's footprint is from the truth, by size and latitude.

The truth is the ray response, the largest value of the Gaussian along each ray; projection `ray` computes it, the
others approximate it. The error of a footprint is the integral over the sphere of |footprint - truth|, relative to the
integral of the truth. All of it without low-pass and without the cut at 1/255: this is the projection alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.render.contract import RenderOptions
from padgs.render.cubemap import FACES
from padgs.render.planar import PlanarFootprints
from padgs.render.projection import project
from padgs.sphere.camera import Camera, Panorama, Pinhole
from padgs.sphere.panorama import direction, rays, row_latitudes

SIGMAS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)  # degrees
LATITUDES = (0.0, 30.0, 45.0, 60.0, 70.0, 80.0, 85.0, 89.0)  # degrees
PIXELS_PER_SIGMA = 4  # a sum over pixels is then an integral, to far more digits than are shown


def footprint_error(projection: str, sigma: float, latitude: float) -> float:
    """Error of the footprint of one round Gaussian against the ray response, as a share of its mass.

    Args:
        projection: erp, tangent, ray, or cubemap for projection pinhole on the faces of a cube.
        sigma: standard deviation as seen from the camera, in degrees: scale / distance.
        latitude: of its mean, in degrees, positive down. On a cube its meridian is a degree beside the middle of the
            front face; up to 45 degrees the latitude is then the angle from the middle of a face, beyond it the
            complement is. (Exactly on the middle the mean would lie in the planes of the faces around, which would not
            draw it at all; a degree beside, they do.)
    """
    gaussian = _round(sigma, latitude)
    height = max(180, round(180 * PIXELS_PER_SIGMA / sigma))
    panorama = Panorama(2 * height, height)
    directions = rays(panorama.width, panorama.height, dtype=torch.float64)
    cosine = directions @ gaussian.means[0]
    scale = gaussian.scales[0, 0]
    truth = torch.where(cosine > 0, torch.exp(-0.5 * (1 - cosine**2) / scale**2), 0.0)
    footprint = _FOOTPRINTS[projection](gaussian, panorama, directions)
    area = torch.cos(row_latitudes(panorama.height, dtype=torch.float64))[:, None]
    return ((area * (footprint - truth).abs()).sum() / (area * truth).sum()).item()


def _round(sigma: float, latitude: float) -> Gaussians:
    longitude, latitude_rad = torch.deg2rad(torch.tensor([[1.0], [latitude]], dtype=torch.float64))
    mean = direction(longitude, latitude_rad)
    one = torch.ones(1, dtype=torch.float64)
    scales = torch.full((1, 3), math.radians(sigma), dtype=torch.float64)
    return Gaussians(mean, torch.eye(4, dtype=torch.float64)[:1], scales, one, torch.ones_like(mean))


def _on_panorama(projection: str) -> Callable[[Gaussians, Panorama, Tensor], Tensor]:
    def footprint(gaussian: Gaussians, panorama: Panorama, _directions: Tensor) -> Tensor:
        rows, columns = torch.meshgrid(torch.arange(panorama.height), torch.arange(panorama.width), indexing="ij")
        values = _values(gaussian, torch.eye(4).double(), panorama, projection, rows.flatten(), columns.flatten())
        return values.view(panorama.height, panorama.width)

    return footprint


def _on_faces(gaussian: Gaussians, panorama: Panorama, directions: Tensor) -> Tensor:
    """Projection pinhole, evaluated exactly where the panorama's pixels look: no face is resampled."""
    focal = panorama.focal
    lens = Pinhole(math.ceil(2 * focal), math.ceil(2 * focal), focal, focal, focal, focal)
    directions = directions.flatten(0, 1)
    face = (directions @ FACES[:, 2].T).argmax(-1)
    footprint = torch.zeros(len(directions), dtype=torch.float64)
    for index, turn in enumerate(FACES):
        on_face = face == index
        x, y, z = (directions[on_face] @ turn.T).unbind(-1)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = turn
        rows, columns = focal * y / z + focal - 0.5, focal * x / z + focal - 0.5
        footprint[on_face] = _values(gaussian, pose, lens, "pinhole", rows, columns)
    return footprint.view(panorama.height, panorama.width)


def _values(
    gaussian: Gaussians, pose: Tensor, camera: Camera, projection: str, rows: Tensor, columns: Tensor
) -> Tensor:
    """exp(-q / 2) at pixels [P], which may lie between the pixel centres in a plane."""
    footprints = project(gaussian, pose, camera, RenderOptions(projection=projection, low_pass=0.0))
    if isinstance(footprints, PlanarFootprints):  # boxes belong to the cut at 1/255, which is left out here
        everywhere = footprints.boxes.new_tensor([[-math.inf, math.inf, -math.inf, math.inf]])
        footprints = replace(footprints, boxes=everywhere)
    if not footprints.visible[0]:
        return torch.zeros(len(rows), dtype=torch.float64)
    q, acts = footprints.squared_distance(torch.tensor([0]), rows, columns)
    return torch.where(acts, torch.exp(-0.5 * q), 0.0)[:, 0]


_FOOTPRINTS = {
    "erp": _on_panorama("erp"),
    "tangent": _on_panorama("tangent"),
    "ray": _on_panorama("ray"),
    "cubemap": _on_faces,
}
