"""A panorama through six pinhole faces: how perspective renderers are commonly taken to the sphere.

The faces of a cube around the camera are drawn one by one, a little wider than 90 degrees, and each pixel of the
panorama is interpolated within the one face that it looks through. Order is by radial distance, so the faces agree on
it. Projection `ray` gives one and the same image on all faces, up to interpolation; `pinhole` flattens a Gaussian onto
the plane of each face, so that its footprint changes a little from face to face: the seams of published cube-map
baselines, which no resampling removes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from math import ceil, pi

import torch
from torch import Tensor

from padgs.geometry.camera import Panorama, Pinhole
from padgs.geometry.panorama import rays
from padgs.render.contract import Backend, Rendering, Request
from padgs.render.projection import camera_frame
from padgs.render.projective import shift_of_probe

FINENESS = 2  # pixels per radian at the middle of a face, where it is coarsest, over those of the panorama's horizon

# face_from_camera: turned and looked through, each face is a camera like any other (x right, y down, z forward).
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


def face_camera(panorama: Panorama, face_size: int | None = None) -> Pinhole:
    """The camera of all six faces: 90 degrees, and at least a pixel more at each border.

    A bilinear sample at the very edge of a face needs the pixel beyond it; with that pixel drawn by the same face, two
    faces that meet differ by interpolation alone.

    Args:
        panorama: what the faces will be resampled to.
        face_size: pixels across 90 degrees. If not given, the centre of a face has `FINENESS` times the pixels per
            radian of the panorama, W / 2 pi (H / pi where that is more). With as many, W / pi across, faces have all
            the pixels it takes, but interpolating between them blurs (docs/projections.md).
    """
    focal = FINENESS * max(panorama.width / (2 * pi), panorama.height / pi) if face_size is None else face_size / 2
    size = 2 * (ceil(focal) + 1)
    return Pinhole(size, size, focal, focal, size / 2, size / 2)


def rasterize_cubemap(rasterize: Backend, request: Request) -> Rendering:
    """Draw a panorama with a backend's perspective views; low-pass filters are of the size of its own pixels."""
    gaussians, cam_from_world, camera = request.gaussians, request.cam_from_world, request.camera
    assert isinstance(camera, Panorama), type(camera)  # `check_inputs` has seen to it
    if request.probe is not None:  # it is given in units of the panorama, so it moves the means, once for all faces
        shift = shift_of_probe(camera_frame(request)[0], request.probe)
        gaussians = replace(gaussians, means=gaussians.means + shift @ cam_from_world[:3, :3])
    lens = face_camera(camera, request.options.face_size)
    turns = _turns(cam_from_world.dtype, cam_from_world.device)
    options = replace(request.options, cubemap=False, face_size=None).on_finer_pixels(lens.focal / camera.focal)
    each = replace(request, gaussians=gaussians, camera=lens, options=options, probe=None)
    faces = [rasterize(replace(each, cam_from_world=turn @ cam_from_world)) for turn in turns]
    return panorama_from_faces(faces, camera, lens)


def panorama_from_faces(faces: list[Rendering], panorama: Panorama, lens: Pinhole) -> Rendering:
    """Six renderings as one of the panorama, differentiable by what the faces are differentiable by.

    Depth is radial and therefore the same number on every face; what is interpolated is depth times coverage, and
    coverage, so that depths are not mixed with the zeros of empty pixels. Counters are sums over the faces, but for
    `gaussians` and `visible`.
    """
    like = faces[0].image
    pixels, weights = _corners(panorama, lens, like.device)
    weights = weights.to(like.dtype)
    coverage = torch.stack([1 - face.transmittance for face in faces])
    depth = torch.stack([face.depth for face in faces]) * coverage
    image = torch.stack([face.image for face in faces])
    channels = torch.cat((image, coverage[..., None], depth[..., None]), dim=-1).flatten(0, 2)  # [6 S S, 5]
    resampled = (weights[:, :, None] * channels[pixels]).sum(1)  # [H W, 5]
    image, coverage, depth = resampled.view(panorama.height, panorama.width, 5).split((3, 1, 1), dim=-1)
    covered = coverage > 0
    depth = torch.where(covered, depth, 0) / torch.where(covered, coverage, 1)
    visible = torch.stack([face.visible for face in faces]).any(0)
    return Rendering(image, (1 - coverage).squeeze(-1), depth.squeeze(-1), visible, SummedCounters(faces, visible))


class SummedCounters(Mapping[str, int]):
    """Of several drawings of the same Gaussians; added up, which waits for a GPU, when somebody asks."""

    def __init__(self, parts: Sequence[Rendering], visible: Tensor) -> None:
        """`visible` [N]: which Gaussians can be seen in any of the parts."""
        self._of_parts, self._visible = [part.counters for part in parts], visible

    def __getitem__(self, name: str) -> int:
        if name == "gaussians":
            return len(self._visible)
        return int(self._visible.sum()) if name == "visible" else sum(counters[name] for counters in self._of_parts)

    def __iter__(self) -> Iterator[str]:
        return iter(self._of_parts[0])

    def __len__(self) -> int:
        return len(self._of_parts[0])


@lru_cache(maxsize=16)
def _turns(dtype: torch.dtype, device: torch.device) -> Tensor:
    """From the camera to each face, [6, 4, 4]."""
    turns = torch.eye(4, dtype=dtype).repeat(6, 1, 1)
    turns[:, :3, :3] = FACES
    return turns.to(device)


@lru_cache(maxsize=16)
def _corners(panorama: Panorama, lens: Pinhole, device: torch.device) -> tuple[Tensor, Tensor]:
    """Where a panorama's pixels look: four pixels [H W, 4] int64 of the stacked faces, and their weights [H W, 4]."""
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
