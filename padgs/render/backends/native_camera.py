"""Cameras as the native library takes them."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import MutableMapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable
from padgs.geometry.panorama import row_latitudes
from padgs.native.abi import NativeCamera, RayPointers, pointer
from padgs.render.contract import RenderOptions
from padgs.render.low_pass import low_pass_of

CPU = torch.device("cpu")
FAR_OFF = 0.3  # radians; with rays further off a panorama's its bounds would exclude little
SLACK = 1e-5  # radians; rounding must never cost a contribution
CHUNK = 16  # pixels; rows of ray tables are padded to whole chunks
PROJECTIONS = ("erp", "pinhole", "tangent", "ray")  # numbered as in csrc/abi.h
MODELS = (Panorama, Pinhole, RayTable)


class NativeRays(NamedTuple):
    """The tensors behind a `RayPointers`, which only points to them."""

    column_sine: Tensor | None = None  # [padded W]
    column_cosine: Tensor | None = None
    row_sine: Tensor | None = None  # [H]
    row_cosine: Tensor | None = None
    table: Tensor | None = None  # [H, 3, padded W]

    def native(self) -> RayPointers:
        """Pointers to the tensors; they must outlive it."""
        return RayPointers(*map(pointer, self))


def native_camera(cam_from_world: Tensor, camera: Camera, options: RenderOptions) -> NativeCamera:
    """Pose, camera and options in one structure.

    Raises:
        ValueError: a projection that the library does not know.
    """
    if options.projection not in PROJECTIONS:
        raise ValueError(
            f"the native libraries do not know projection {options.projection!r}; known: {', '.join(PROJECTIONS)}"
        )
    low_pass, off_panorama = low_pass_of(options, camera), _off_panorama(camera)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy) if isinstance(camera, Pinhole) else (0.0, 0.0, 0.0, 0.0)
    return NativeCamera(
        camera.width,
        camera.height,
        PROJECTIONS.index(options.projection),
        MODELS.index(type(camera)),
        (ctypes.c_float * 12)(*cam_from_world[:3].detach().reshape(-1).tolist()),
        options.near,
        low_pass.own,
        off_panorama >= 0 or (isinstance(camera, Panorama) and (options.wrap or options.projection != "erp")),
        options.bounds == "square",
        *lens,
        low_pass.widen,
        off_panorama,
        low_pass.compensate,
        options.near_cull == "ellipsoid",
    )


def _off_panorama(camera: Camera) -> float:
    """The largest angle in radians between a ray of a table and the one of a panorama at the same pixel; -1 if it is
    large: a table that is nearly a panorama has its bounds, any other may look anywhere."""
    if not isinstance(camera, RayTable):
        return -1.0
    known = _off_panoramas.get(camera.table)
    if known is None or known[0] != camera.table._version:
        table = camera.table.detach().float()
        chord = (table - _panorama_rays(camera.width, camera.height, table.device)).norm(dim=-1)
        angle = 2 * torch.asin((chord.max() / 2).clamp(max=1)).item() + SLACK  # waits for a GPU, once for a table
        known = _off_panoramas[camera.table] = camera.table._version, angle if angle < FAR_OFF else -1.0
    return known[1]


# Of tables as they were at some version of theirs.
_off_panoramas: MutableMapping[Tensor, tuple[int, float]] = WeakTensorKeyDictionary()


@functools.lru_cache(maxsize=4)
def _panorama_rays(width: int, height: int, device: torch.device) -> Tensor:
    return Panorama(width, height).rays(dtype=torch.float32).to(device)


def native_rays(camera: Camera, device: torch.device = CPU) -> NativeRays:
    """Directions of the pixels; computed once for a camera and a device, and again where a table has changed."""
    if not isinstance(camera, RayTable):
        return _formula_rays(camera, device)
    state, known = (camera.table._version, device), _padded_tables.get(camera.table)
    if known is None or known[0] != state:
        padded = _padded_table(camera.table.detach().to(device, torch.float32))
        known = _padded_tables[camera.table] = state, padded
    return NativeRays(table=known[1])


# Of tables as they were at some version of theirs, on a device.
_padded_tables: MutableMapping[Tensor, tuple[tuple[int, torch.device], Tensor]] = WeakTensorKeyDictionary()


@functools.lru_cache(maxsize=16)
def _formula_rays(camera: Panorama | Pinhole, device: torch.device) -> NativeRays:
    if isinstance(camera, Pinhole):
        return NativeRays(table=_padded_table(camera.rays()).to(device, torch.float32))
    padded = -(-camera.width // CHUNK) * CHUNK
    longitude = ((torch.arange(padded, dtype=torch.float64) + 0.5) / camera.width - 0.5) * (2 * torch.pi)
    latitude = row_latitudes(camera.height, dtype=torch.float64)
    angles = (longitude.sin(), longitude.cos(), latitude.sin(), latitude.cos())
    return NativeRays(*(values.to(device, torch.float32) for values in angles))


def _padded_table(rays: Tensor) -> Tensor:
    padding = -rays.shape[1] % CHUNK  # with copies of the last column: any direction, but a direction
    return torch.nn.functional.pad(rays.permute(0, 2, 1), (0, padding), mode="replicate").contiguous()
