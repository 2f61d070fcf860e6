"""The common part of the native rasterizers: cameras and rays for the libraries, and one `torch.autograd.Function`.

Defines the inputs with gradients, the tensors kept for the backward pass, and the gradients of pose, background and
rays. float32 only.
"""

import ctypes
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils.weak import WeakTensorKeyDictionary

from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable
from padgs.geometry.panorama import row_latitudes
from padgs.native.abi import ABSGRAD_SUM, Inputs, NativeCamera, RayPointers, pointer
from padgs.render.contract import Removals, Rendering, RenderOptions, Request
from padgs.render.projection import low_pass_of

TILE = 16  # pixels
CPU = torch.device("cpu")
MAX_DEVIATION = 0.3  # radians; with rays further from those of a panorama, the bounds of a panorama exclude little
SLACK = 1e-5  # radians; rounding must never cost a contribution
CHUNK = 16  # pixels; rows of ray tables are padded to whole chunks
PROJECTIONS = ("erp", "pinhole", "tangent", "ray")  # numbered as in csrc/abi.h
MODELS = (Panorama, Pinhole, RayTable)
Pixels = tuple[Tensor, Tensor, Tensor]  # image [H, W, 3], transmittance [H, W], depth [H, W]


class NativeRays(NamedTuple):
    """The tensors that a `RayPointers` points to."""

    column_sine: Tensor | None = None  # [padded W]
    column_cosine: Tensor | None = None
    row_sine: Tensor | None = None  # [H]
    row_cosine: Tensor | None = None
    table: Tensor | None = None  # [H, 3, padded W]

    def native(self) -> RayPointers:
        """Return pointers to the tensors, which must outlive them."""
        return RayPointers(*map(pointer, self))


class Upstream(NamedTuple):
    """Gradients of the pixels, and the gradient of the rays, which the backward pass adds to."""

    image: Tensor
    transmittance: Tensor | None
    depth: Tensor | None
    rays: Tensor | None  # zeros of the shape of the table; added to
    absgrad: bool  # whether to compute the absolute positional gradient


class NativeImage(ABC):
    """One image of a native library, with everything that its backward pass needs besides the pixels.

    Autograd keeps the pixels, and they refer to this object; a reference back would keep both alive.
    """

    counters: Mapping[str, int]
    rays: NativeRays

    def __init__(self, request: Request) -> None:
        self.check(request.gaussians.means)
        self.camera, self.options = request.camera, request.options

    @classmethod
    def rasterize(cls, request: Request) -> Rendering:
        """Render the request, differentiably; OSError: no library, RuntimeError: not compiled for this GPU."""
        leaves = Leaves(
            **vars(request.gaussians),
            mean_offsets=request.mean_offsets,
            absgrad=request.absgrad,
            cam_from_world=request.cam_from_world,
            background=request.background,
            table=request.camera.table if isinstance(request.camera, RayTable) else None,
        )
        image, grad_enabled = cls(request), torch.is_grad_enabled()  # always false inside `apply`
        color, transmittance, depth, visible = _Rasterize.apply(image, grad_enabled, *leaves)
        return Rendering(color, transmittance, depth, visible, image.counters)

    @classmethod
    def leave_one_out(cls, request: Request, target: Tensor, weight: Tensor) -> Removals:
        """Return leave-one-out scores of sorted blending, without gradients; raises as `rasterize` does."""
        image, attributes = cls(request), [tensor.contiguous() for tensor in vars(request.gaussians).values()]
        mean_offsets = None if request.mean_offsets is None else request.mean_offsets.contiguous()
        pose, background = request.cam_from_world.contiguous(), request.background.contiguous()
        inputs = Inputs(len(request.gaussians), *map(pointer, (*attributes, mean_offsets)))
        pixels, _ = image.draw(inputs, pose, background, differentiated=False)
        return image.removals(pixels, background, target, weight)

    @staticmethod
    @abstractmethod
    def check(means: Tensor) -> None:
        """Raise ValueError for tensors that the library cannot render."""

    @abstractmethod
    def draw(self, inputs: Inputs, pose: Tensor, background: Tensor, *, differentiated: bool) -> tuple[Pixels, Tensor]:
        """Return the pixels, and which Gaussians are visible, [N] bool; sets `counters` and `rays`."""

    @abstractmethod
    def gradient_sums(self, pixels: Pixels, background: Tensor, upstream: Upstream) -> Tensor:
        """Return the sums over pixels [N, GRADIENT_SUMS] from which `project_backward` computes gradients."""

    @abstractmethod
    def project_backward(
        self, inputs: Inputs, pose: Tensor, sums: Tensor, gradients: list[Tensor | None], *, needs_pose: bool
    ) -> Tensor | None:
        """Fill the gradients of means, quats, scales, opacities, colors, mean_offsets; return that of the pose [12]."""

    @abstractmethod
    def removals(self, pixels: Pixels, background: Tensor, target: Tensor, weight: Tensor) -> Removals:
        """Return the leave-one-out scores of sorted blending; `weight` [H, W] sums to 1."""


class Leaves(NamedTuple):
    """The inputs with gradients, in the order of the autograd function; or a flag for each."""

    means: Any
    quats: Any
    scales: Any
    opacities: Any
    colors: Any
    mean_offsets: Any = None
    absgrad: Any = None
    cam_from_world: Any = None
    background: Any = None
    table: Any = None  # of the camera's rays


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, native_image: NativeImage, grad_enabled: bool, *leaves: Tensor | None):
        named = Leaves(*leaves)
        attributes = [None if t is None else t.detach().contiguous() for t in named[:6]]
        pose, background = (t.detach().contiguous() for t in (named.cam_from_world, named.background))
        inputs = Inputs(len(named.means), *map(pointer, attributes))
        differentiated = grad_enabled and any(ctx.needs_input_grad)
        pixels, visible = native_image.draw(inputs, pose, background, differentiated=differentiated)
        ctx.mark_non_differentiable(visible)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*attributes, pose, background, *pixels)
        ctx.native_image = native_image
        return *pixels, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_transmittance, grad_depth, _):
        *attributes, pose, background, image, transmittance, depth = ctx.saved_tensors
        native_image, needs = ctx.native_image, Leaves(*ctx.needs_input_grad[2:])
        grad_image = torch.zeros_like(image) if grad_image is None else grad_image.contiguous()
        grad_transmittance, grad_depth = (g if g is None else g.contiguous() for g in (grad_transmittance, grad_depth))
        grad_rays = torch.zeros_like(native_image.rays.table) if needs.table else None
        upstream = Upstream(grad_image, grad_transmittance, grad_depth, grad_rays, needs.absgrad)
        sums = native_image.gradient_sums((image, transmittance, depth), background, upstream)
        inputs = Inputs(len(sums), *map(pointer, attributes))
        gradients = [None if t is None else torch.empty_like(t) for t in attributes]
        pose_gradient = native_image.project_backward(inputs, pose, sums, gradients, needs_pose=needs.cam_from_world)
        leaves = Leaves(*gradients)
        if needs.absgrad:
            leaves = leaves._replace(absgrad=sums[:, ABSGRAD_SUM].clone())
        if pose_gradient is not None:
            leaves = leaves._replace(cam_from_world=torch.zeros_like(pose))
            leaves.cam_from_world[:3] = pose_gradient.view(3, 4).to(pose.dtype)
        if needs.background:
            leaves = leaves._replace(background=(grad_image * transmittance[..., None]).sum((0, 1)))
        if grad_rays is not None:
            leaves = leaves._replace(table=grad_rays[:, :, : image.shape[1]].permute(0, 2, 1))
        return None, None, *leaves


class Strips:
    """Strips of tile rows of an image; a single strip is kept for the backward pass, several are made again."""

    def __init__(self, make: Callable[[Any, int, int], Any], cuts: list[int]) -> None:
        self._make, self._cuts, self._only = make, cuts, None

    def strips(self) -> Iterator[Any]:
        """Yield the strips from top to bottom."""
        for first, end in zip(self._cuts, self._cuts[1:], strict=False):
            strip = self._only or self._make(self, first, end)
            self._only = strip if len(self._cuts) == 2 else None
            yield strip


def strip_cuts(per_row: list[int], max_instances: int) -> list[int]:
    """Return the rows of tiles at which to cut so that no strip of several rows exceeds the limit."""
    cuts, inside = [0], 0
    for row, instances in enumerate(per_row):
        if inside and inside + instances > max_instances:
            cuts.append(row)
            inside = 0
        inside += instances
    return [*cuts, len(per_row)]


def native_camera(cam_from_world: Tensor, camera: Camera, options: RenderOptions) -> NativeCamera:
    """Return pose, camera and options in one structure; ValueError for an unknown projection."""
    if options.projection not in PROJECTIONS:
        known = ", ".join(PROJECTIONS)
        raise ValueError(f"the native libraries do not know projection {options.projection!r}; known: {known}")
    low_pass = low_pass_of(options, camera)
    deviation = off_panorama(camera.table) if isinstance(camera, RayTable) else -1.0
    lens = (camera.fx, camera.fy, camera.cx, camera.cy) if isinstance(camera, Pinhole) else (0.0, 0.0, 0.0, 0.0)
    return NativeCamera(
        camera.width,
        camera.height,
        PROJECTIONS.index(options.projection),
        MODELS.index(type(camera)),
        (ctypes.c_float * 12)(*cam_from_world[:3].detach().reshape(-1).tolist()),
        options.near,
        low_pass.in_plane,
        deviation >= 0 or (isinstance(camera, Panorama) and (options.wrap or options.projection != "erp")),
        options.bounds == "square",
        *lens,
        low_pass.widen,
        deviation,
        low_pass.compensate,
        options.near_cull == "ellipsoid",
        options.steepness,
    )


_kept: MutableMapping[Tensor, dict[Callable, tuple[Any, Any]]] = WeakTensorKeyDictionary()


def _of_table(make: Callable[[Tensor, torch.device], Any], table: Tensor, device: torch.device) -> Any:
    """Return `make(table, device)`, computed again only after the table changed or for another device."""
    values, state = _kept.setdefault(table, {}), (table._version, device)
    if make not in values or values[make][0] != state:
        values[make] = state, make(table.detach(), device)
    return values[make][1]


def off_panorama(table: Tensor) -> float:
    """Return the largest angle in radians between rays of a table and a panorama; -1 if it is large: without bounds."""
    return _of_table(_deviation, table, table.device)


def _deviation(table: Tensor, device: torch.device) -> float:
    chord = (table.float() - _panorama_rays(table.shape[1], table.shape[0], device)).norm(dim=-1)
    angle = 2 * torch.asin((chord.max() / 2).clamp(max=1)).item() + SLACK  # waits for a GPU, once for a table
    return angle if angle < MAX_DEVIATION else -1.0


@functools.lru_cache(maxsize=4)
def _panorama_rays(width: int, height: int, device: torch.device) -> Tensor:
    return Panorama(width, height).rays(dtype=torch.float32).to(device)


def native_rays(camera: Camera, device: torch.device = CPU) -> NativeRays:
    """Return the directions of the pixels; computed once for a camera and device, and again after a table changed."""
    if isinstance(camera, RayTable):
        return NativeRays(table=_of_table(_padded_table, camera.table, device))
    return _formula_rays(camera, device)


@functools.lru_cache(maxsize=16)
def _formula_rays(camera: Panorama | Pinhole, device: torch.device) -> NativeRays:
    if isinstance(camera, Pinhole):
        return NativeRays(table=_padded_table(camera.rays(), CPU).to(device))
    padded = -(-camera.width // CHUNK) * CHUNK
    longitude = ((torch.arange(padded, dtype=torch.float64) + 0.5) / camera.width - 0.5) * (2 * torch.pi)
    latitude = row_latitudes(camera.height, dtype=torch.float64)
    angles = (longitude.sin(), longitude.cos(), latitude.sin(), latitude.cos())
    return NativeRays(*(values.to(device, torch.float32) for values in angles))


def _padded_table(rays: Tensor, device: torch.device) -> Tensor:
    padding = -rays.shape[1] % CHUNK  # copies of the last column are valid directions
    columns = rays.to(device, torch.float32).permute(0, 2, 1)
    return torch.nn.functional.pad(columns, (0, padding), mode="replicate").contiguous()
