"""Compute the footprint error of each projection by size and latitude.

    python tests/support/footprint_error.py

writes the table in docs/notes/projection_error.md in half a minute. Tests compare the table with the numbers
computed here.

The truth is the ray response, the largest value of the Gaussian along each ray; projection `ray` computes it, the
others approximate it. The error of a footprint is the integral over the sphere of |footprint - truth|, relative to the
integral of the truth. Without low-pass and without the cut at 1/255: the error of the projection alone.
"""

import math
import re
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Camera, Panorama, Pinhole
from padgs.geometry.panorama import direction, rays, row_latitudes
from padgs.render.contract import RenderOptions, Request
from padgs.render.cubemap import FACES
from padgs.render.projection import PlanarFootprints, project

SIGMAS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)  # degrees
LATITUDES = (0.0, 30.0, 45.0, 60.0, 70.0, 80.0, 85.0, 89.0)  # degrees
PIXELS_PER_SIGMA = 4  # a sum over pixels then equals the integral to more digits than are shown

FOLDER = Path(__file__).resolve().parents[2] / "docs"
PROJECTIONS = ("erp", "tangent", "cubemap")
# The same quantity computed by another program, in percent.
REFERENCE = {
    "erp": {
        0.5: {0: 0, 45: 0.4, 70: 1.0, 85: 3.9, 89: 19.2},
        2: {0: 0.2, 45: 1.4, 70: 3.8, 85: 15.6, 89: 28.9},
        5: {0: 1.2, 45: 3.6, 70: 9.4, 85: 27.5, 89: 18.3},
        10: {0: 4.8, 45: 7.6, 70: 17.3, 85: 24.5, 89: 9.0},
    },
    "tangent": {sigma: {0: percent} for sigma, percent in ((0.5, 0.0), (2, 0.5), (5, 3.0), (10, 11.2), (20, 38.6))},
    "cubemap": {},
}


def footprint_error(projection: str, sigma: float, latitude: float) -> float:
    """Return the error of the footprint of one round Gaussian against the ray response, as a share of its mass.

    Args:
        projection: erp, tangent, ray, or cubemap for projection pinhole on the faces of a cube.
        sigma: standard deviation as seen from the camera, in degrees: scale / distance.
        latitude: of its mean, in degrees, positive down. Its meridian is one degree beside the centre of the front
            face of a cube, because at the centre the mean would lie in the planes of neighbouring faces, which would
            not render it. The angle from the centre of a face is the latitude up to 45 degrees, then its complement.
    """
    gaussian = _round(sigma, latitude)
    height = max(180, round(180 * PIXELS_PER_SIGMA / sigma))
    panorama = Panorama(2 * height, height)
    directions = rays(panorama.width, panorama.height, dtype=torch.float64)
    cosine = directions @ gaussian.means[0]
    scale = gaussian.scales[0, 0]
    truth = torch.where(cosine > 0, torch.exp(-0.5 * (1 - cosine**2) / scale**2), 0.0)
    if projection == "cubemap":
        footprint = _on_faces(gaussian, panorama, directions)
    else:
        rows, columns = torch.meshgrid(torch.arange(panorama.height), torch.arange(panorama.width), indexing="ij")
        pose = torch.eye(4, dtype=torch.float64)
        footprint = _values(gaussian, pose, panorama, projection, rows.flatten(), columns.flatten()).view(rows.shape)
    area = torch.cos(row_latitudes(panorama.height, dtype=torch.float64))[:, None]
    return ((area * (footprint - truth).abs()).sum() / (area * truth).sum()).item()


def _round(sigma: float, latitude: float) -> Gaussians:
    longitude, latitude_rad = torch.deg2rad(torch.tensor([[1.0], [latitude]], dtype=torch.float64))
    mean = direction(longitude, latitude_rad)
    one = torch.ones(1, dtype=torch.float64)
    scales = torch.full((1, 3), math.radians(sigma), dtype=torch.float64)
    return Gaussians(mean, torch.eye(4, dtype=torch.float64)[:1], scales, one, torch.ones_like(mean))


def _on_faces(gaussian: Gaussians, panorama: Panorama, directions: Tensor) -> Tensor:
    """Return footprints of projection pinhole along the rays of the panorama, without resampling of faces."""
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


def _values(gaussian: Gaussians, pose: Tensor, lens: Camera, projection: str, rows: Tensor, columns: Tensor) -> Tensor:
    """Return exp(-q / 2) at pixels [P], which may lie between pixel centres in a plane."""
    options = RenderOptions(projection=projection, low_pass=0.0)
    footprints = project(Request(gaussian, pose, lens, options, background=pose.new_zeros(3)))
    if isinstance(footprints, PlanarFootprints):  # boxes belong to the cut at 1/255, which is not applied here
        everywhere = footprints.boxes.new_tensor([[-math.inf, math.inf, -math.inf, math.inf]])
        footprints = replace(footprints, boxes=everywhere)
    if not footprints.visible[0]:
        return torch.zeros(len(rows), dtype=torch.float64)
    q, acts = footprints.squared_distance(torch.tensor([0]), rows, columns)
    return torch.where(acts, torch.exp(-0.5 * q), 0.0)[:, 0]


def markdown(errors: dict[str, list[list[float]]]) -> str:
    """Return the errors as a table in percent, with the reference numbers in brackets."""
    lines = ["| projection | σ | " + " | ".join(f"{latitude:g}°" for latitude in LATITUDES) + " |"]
    lines.append("|---|---|" + "---|" * len(LATITUDES))
    for projection in PROJECTIONS:
        for sigma, row in zip(SIGMAS, errors[projection], strict=True):
            known = REFERENCE[projection].get(sigma, {})
            cells = [
                f"{100 * error:.1f}" + (f" ({known[latitude]:g})" if latitude in known else "")
                for latitude, error in zip(LATITUDES, row, strict=True)
            ]
            lines.append(f"| {projection} | {sigma:g}° | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Compute the errors and write the table."""
    errors = {
        projection: [[footprint_error(projection, sigma, latitude) for latitude in LATITUDES] for sigma in SIGMAS]
        for projection in PROJECTIONS
    }
    page = FOLDER / "notes" / "projection_error.md"
    between = re.compile(r"(<!-- table -->\n).*(<!-- end -->)", re.DOTALL)
    page.write_text(between.sub(lambda found: found[1] + markdown(errors) + "\n" + found[2], page.read_text()))


if __name__ == "__main__":
    main()
