"""Panoramas from six pinhole faces, the common way to use a perspective renderer on the sphere.

The faces of a cube around the camera are rendered one by one, a little wider than 90 degrees, and each pixel of the
panorama is interpolated within the face that its ray meets. Gaussians are sorted by radial distance, so all faces agree
on the order. Projection `ray` gives the same image on all faces, up to interpolation; `pinhole` flattens a Gaussian
onto the plane of each face, so its footprint changes from face to face: the seams of published cubemap baselines.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from math import ceil, pi

import torch
from torch import Tensor

from padgs.geometry.camera import Panorama, Pinhole
from padgs.geometry.panorama import rays
from padgs.render.contract import Backend, LazyCounters, Rendering, Request
from padgs.render.projection import camera_frame
from padgs.render.projective import mean_shift

FINENESS = 2  # pixels per radian at the centre of a face, where it is coarsest, relative to the panorama's horizon

# face_from_camera; each face is an ordinary camera (x right, y down, z forward).
FACES = torch.tensor(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # front, z
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # right, x
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],  # back, -z
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],  # left, -x
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # down, y
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # up, -y
    ],
    dtype=torch.float64,
)


def face_camera(panorama: Panorama) -> Pinhole:
    """Return the camera of all six faces: 90 degrees, and at least a pixel more at each border.

    A bilinear sample at the edge of a face needs the pixel beyond it; because the same face renders that pixel,
    neighbouring faces differ by interpolation alone. The centre of a face has `FINENESS` times the pixels per radian of
    the panorama; with as many, interpolation would blur.
    """
    focal = FINENESS * max(panorama.width / (2 * pi), panorama.height / pi)
    size = 2 * (ceil(focal) + 1)
    return Pinhole(size, size, focal, focal, size / 2, size / 2)


def rasterize_cubemap(rasterize: Backend, request: Request) -> Rendering:
    """Render a panorama from perspective views of a backend; low-pass filters have the size of its own pixels."""
    gaussians, cam_from_world, camera = request.gaussians, request.cam_from_world, request.camera
    assert isinstance(camera, Panorama), type(camera)  # guaranteed by `check_inputs`
    if request.mean_offsets is not None:  # in units of the panorama, so they move the means, once for all faces
        shift = mean_shift(camera_frame(request)[0], request.mean_offsets)
        gaussians = replace(gaussians, means=gaussians.means + shift @ cam_from_world[:3, :3])
    lens = face_camera(camera)
    turns = _turns(cam_from_world.dtype, cam_from_world.device)
    options = replace(request.options, cubemap=False).on_finer_pixels(lens.focal / camera.focal)
    each = replace(request, gaussians=gaussians, camera=lens, options=options, mean_offsets=None)
    faces = [rasterize(replace(each, cam_from_world=turn @ cam_from_world)) for turn in turns]
    return panorama_from_faces(faces, camera, lens)


def panorama_from_faces(faces: list[Rendering], panorama: Panorama, lens: Pinhole) -> Rendering:
    """Resample the renderings of six faces to a panorama, differentiably.

    Depth is radial, so faces agree on it. Counters are sums over the faces, except `gaussians` and `visible`.
    """
    channels = torch.stack([channels_of(face) for face in faces]).flatten(0, 2)  # [6 S S, 5]
    pixels, weights = _corners(panorama, lens, channels.device)
    # On each device the one of two indexings whose gradient is deterministic.
    corners = (
        channels[pixels] if channels.is_cuda else channels.index_select(0, pixels.flatten()).view(*pixels.shape, 5)
    )
    resampled = (weights.to(channels)[:, :, None] * corners).sum(1)  # [H W, 5]
    visible = torch.stack([face.visible for face in faces]).any(0)
    like = replace(faces[0], visible=visible, counters=summed_counters(faces, visible))
    return from_channels(resampled.view(panorama.height, panorama.width, 5), like)


def channels_of(rendering: Rendering) -> Tensor:
    """Return image, coverage, and depth times coverage [H, W, 5], which may be interpolated.

    Depth alone would mix with the zeros of empty pixels.
    """
    coverage = (1 - rendering.transmittance)[..., None]
    return torch.cat((rendering.image, coverage, rendering.depth[..., None] * coverage), dim=-1)


def from_channels(channels: Tensor, like: Rendering) -> Rendering:
    """Return a rendering of interpolated channels [H, W, 5], otherwise like another one."""
    image, coverage, depth = channels[..., :3], channels[..., 3], channels[..., 4]
    covered = coverage > 0
    depth = torch.where(covered, depth, 0) / torch.where(covered, coverage, 1)
    return replace(like, image=image, transmittance=1 - coverage, depth=depth)


def summed_counters(parts: Sequence[Rendering], visible: Tensor) -> LazyCounters:
    """Return the summed counters of several renderings of N Gaussians, of which `visible` [N] are seen in any."""
    names = [name for name in parts[0].counters if name not in ("gaussians", "visible")]

    def read() -> list[int]:
        return [int(visible.sum()), *(sum(part.counters[name] for part in parts) for name in names)]

    return LazyCounters({"gaussians": len(visible)}, ("visible", *names), read)


@lru_cache(maxsize=16)
def _turns(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the transforms from the camera to each face, [6, 4, 4]."""
    turns = torch.eye(4, dtype=dtype).repeat(6, 1, 1)
    turns[:, :3, :3] = FACES
    return turns.to(device)


@lru_cache(maxsize=16)
def _corners(panorama: Panorama, lens: Pinhole, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return for each pixel of a panorama four pixels [H W, 4] int64 of the stacked faces, and weights [H W, 4]."""
    directions = rays(panorama.width, panorama.height, dtype=torch.float64).view(-1, 3)
    ahead = directions @ FACES[:, 2].T  # [H W, 6] cosine to the axis of each face
    face = ahead.argmax(-1)
    local = torch.einsum("pij,pj->pi", FACES[face], directions)
    position = local[:, :2] / local[:, 2:] * lens.fx + lens.cx - 0.5  # in pixels, from the centre of the first one
    first = position.floor()
    right, below = (position - first).unbind(-1)
    column, row = first.long().unbind(-1)
    corner = (face * lens.height + row) * lens.width + column
    pixels = torch.stack((corner, corner + 1, corner + lens.width, corner + lens.width + 1), dim=-1)
    weights = torch.stack(((1 - right) * (1 - below), right * (1 - below), (1 - right) * below, right * below), dim=-1)
    return pixels.to(device), weights.to(device)
