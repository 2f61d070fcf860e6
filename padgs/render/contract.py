"""The contract of all rasterizer backends: input, output, and the definition of the image.

All backends match the definition in values and gradients. Each Gaussian that is not culled acts on a pixel through a
squared distance q >= 0 given by the projection; alpha = min(0.99, opacity * exp(-f(q) / 2)), where f(q) = q unless
`kernel` has a steepness; pairs with alpha < 1/255 are skipped. Gaussians are blended front to back by the radial
distance of their mean (ties by index), and a pixel stops *before* the Gaussian that would bring its transmittance below
1e-4. Where alpha is limited to 0.99 its derivative is 0.
Means nearer than 1e-15 or farther than 1e15 world units are culled too: float32 cannot represent their squares.
This is blending "sorted"; "hybrid" differs in order and stop, see `padgs.render.backends.torch.hybrid_weights`.
"""

from __future__ import annotations

import math
from collections import UserDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from padgs.checks import check, check_known
from padgs.gaussians import Gaussians
from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
NEAREST, FURTHEST = 1e-15, 1e15
CORE_ALPHA_MIN = 0.05  # hybrid: fainter fragments belong to the tail
CORE_SIZE, MAX_CORE_SIZE = 16, 256
MAX_SUPERSAMPLING = 8
LOW_PASS_KINDS = {  # of each projection, the default first; defined in `padgs.render.projection`
    "erp": ("pixels", "angular", "solid"),
    "pinhole": ("pixels", "angular", "solid"),
    "tangent": ("angular", "solid"),
    "ray": ("solid", "angular"),
}


def _whole(most: int) -> Callable[[Any], bool]:
    """Return a rule that holds for whole numbers from 1 to `most`."""
    return lambda n: isinstance(n, int) and 1 <= n <= most


@dataclass(frozen=True)
class RenderOptions:
    """Options of the rasterizer. conf/render/released.yaml has those of the published rasterizer."""

    projection: str = "erp"  # erp | tangent | ray | pinhole: docs/renderer.md
    near: float = 0.0  # world units; Gaussians whose mean is at most this far away (pinhole: this deep) are culled
    near_cull: str = "mean"  # what must be farther than near: the mean, or ellipsoid (ray): the whole drawn Gaussian
    # variance of the low-pass filter in square pixels (cubemap: of its panorama; perspective image: at its centre)
    low_pass: float = 0.3
    # n x n samples a pixel, which is their mean; `low_pass` is then in square samples
    supersampling: int = 1
    low_pass_kind: str = "auto"  # pixels, angular or solid; auto: the default of the projection
    # s in [0, 1) of `kernel`, tangent and ray; 0: Gaussians; more: flatter in the middle, with a steeper edge
    steepness: float = 0.0
    wrap: bool = True  # erp: continue footprints across the +-180 degree seam; tangent and ray have none
    cubemap: bool = False  # render a panorama from the six faces of a cube, each a perspective view
    bounds: str = "exact"  # exact: every pixel with alpha >= 1/255; square: 3 standard deviations, as published
    blending: str = "sorted"  # sorted: by distance of means; hybrid: nearest fragments of each ray sorted, others not
    core_size: int = CORE_SIZE  # hybrid: number of sorted fragments of a pixel
    max_instances: int = 1 << 26  # (Gaussian, tile) pairs in memory at once; more are rendered in strips

    def __post_init__(self) -> None:
        check_known(self, bounds=("exact", "square"), near_cull=("mean", "ellipsoid"), blending=("sorted", "hybrid"))
        check(self, "a distance >= 0 in world units", lambda near: 0 <= near < math.inf, "near")
        check(self, "a variance >= 0 in square pixels", lambda v: 0 <= v < math.inf, "low_pass")
        check(self, "in [0, 1)", lambda share: 0 <= share < 1, "steepness")
        check(self, f"from 1 to {MAX_SUPERSAMPLING}", _whole(MAX_SUPERSAMPLING), "supersampling")
        check(self, f"from 1 to {MAX_CORE_SIZE} fragments a pixel", _whole(MAX_CORE_SIZE), "core_size")
        check(self, "at least 1", _whole(1 << 62), "max_instances")
        if self.near_cull == "ellipsoid" and self.projection != "ray":
            raise ValueError(f"near_cull=ellipsoid requires projection 'ray', not {self.projection!r}; set mean")
        if self.steepness and self.projection not in ("tangent", "ray"):
            raise ValueError(f"steepness requires projection 'tangent' or 'ray', not {self.projection!r}; set 0")
        if self.core_size != CORE_SIZE and self.blending != "hybrid":
            raise ValueError(
                f"core_size is {self.core_size}, but blending={self.blending} has no core; set blending=hybrid "
                f"or core_size={CORE_SIZE}"
            )
        if self.bounds == "square" and self.wrap:
            raise ValueError("bounds=square end at the seam, as published; set wrap=false")
        if not self.wrap and self.bounds == "exact" and self.projection in ("tangent", "ray"):
            raise ValueError(f"projection {self.projection!r} has no seam that wrap=false could cut; set wrap=true")
        kinds = LOW_PASS_KINDS.get(self.projection, ())  # () for unknown projections, which `lookup` refuses
        if kinds and self.low_pass_kind not in ("auto", *kinds):
            raise ValueError(
                f"projection {self.projection!r} has no low_pass_kind {self.low_pass_kind!r}; known: auto, "
                f"{', '.join(kinds)}"
            )
        if self.cubemap and self.projection == "erp":
            raise ValueError("projection 'erp' cannot render the faces of a cubemap; set pinhole, tangent or ray")

    def on_finer_pixels(self, times: float) -> RenderOptions:
        """Return options with the same low-pass angle for a camera with `times` the pixels per radian."""
        return replace(self, low_pass=self.low_pass * times**2)

    @property
    def resolved_low_pass_kind(self) -> str:
        """Return the low-pass kind that `auto` selects; other kinds are returned unchanged."""
        return LOW_PASS_KINDS[self.projection][0] if self.low_pass_kind == "auto" else self.low_pass_kind


@dataclass(frozen=True)
class Request:
    """The input of a backend."""

    gaussians: Gaussians  # N, in the world frame
    cam_from_world: Tensor  # [4, 4] in the dtype and on the device of the means
    camera: Camera  # the direction of each pixel
    options: RenderOptions
    background: Tensor  # [3]
    mean_offsets: Tensor | None = None  # [N, 2]; see `padgs.render.render`
    absgrad: Tensor | None = None  # [N]


@dataclass(frozen=True)
class Rendering:
    """The output of a backend. Image, transmittance and depth are differentiable."""

    image: Tensor  # [H, W, 3]
    transmittance: Tensor  # [H, W] in [0, 1], the weight of the background
    depth: Tensor  # [H, W] world units: mean radial distance weighted by contribution; 0 if nothing contributes
    visible: Tensor  # [N] bool: not culled and inside the image
    counters: Mapping[str, int] = field(default_factory=dict)  # gaussians, visible, instances, evaluated pairs, ...


class LazyCounters(UserDict[str, Any]):
    """Counters of which some wait for a GPU; these are read together, on first access."""

    def __init__(self, known: dict[str, int], names: Sequence[str], read: Callable[[], Iterable[int]]) -> None:
        """Keep known counters, and the names of others, whose values `read` returns."""
        super().__init__({**known, **dict.fromkeys(names)})
        self._names, self._read = names, read

    def __getitem__(self, name: str) -> int:
        if self.data[name] is None:
            self.data.update(zip(self._names, self._read(), strict=True))
        return self.data[name]


@dataclass(frozen=True)
class Removals:
    """Leave-one-out scores of N Gaussians in one view, see `padgs.render.leave_one_out`."""

    error: Tensor  # [N] float64, change of the weighted mean square error; < 0: better without it
    change: Tensor  # [N] float64 >= 0, mean square change of the image by the same weights
    contribution: Tensor  # [N] float64 in [0, 1], mean of alpha T by the same weights
    peak: Tensor  # [N] in [0, 1], largest alpha T of any pixel


def kernel(q: Tensor, steepness: float) -> Tensor:
    """Return f(q) = (1 - s) q + s q^2 of squared distances, with the steepness s; alpha = opacity exp(-f(q) / 2).

    1 at one standard deviation, whatever s is. Cf. the generalized exponentials of GES (Hamdi et al. 2024).
    """
    return q * (1 - steepness + steepness * q)


def largest_q(opacities: Tensor, steepness: float) -> Tensor:
    """Return the q >= 0 at which Gaussians of these opacities have alpha = `ALPHA_MIN`; 0 for fainter ones."""
    k, linear = 2 * torch.log((opacities / ALPHA_MIN).clamp(min=1)), 1 - steepness
    return 2 * k / (linear + torch.sqrt(linear**2 + 4 * steepness * k))


Backend = Callable[[Request], Rendering]  # every entry of `padgs.render.BACKENDS`


def check_inputs(request: Request) -> None:
    """Check what native code relies on; values are not read. ValueError for a wrong shape, dtype or device."""
    gaussians, options = request.gaussians, request.options
    count = gaussians.means.shape[0] if gaussians.means.ndim else 0
    shapes = {
        "means": (gaussians.means, (count, 3)),
        "quats": (gaussians.quats, (count, 4)),
        "scales": (gaussians.scales, (count, 3)),
        "opacities": (gaussians.opacities, (count,)),
        "colors": (gaussians.colors, (count, 3)),
        "cam_from_world": (request.cam_from_world, (4, 4)),
        "background": (request.background, (3,)),
    }
    if request.mean_offsets is not None:
        shapes["mean_offsets"] = (request.mean_offsets, (count, 2))
    if request.absgrad is not None:
        shapes["absgrad"] = (request.absgrad, (count,))
        if options.projection != "ray":
            raise ValueError(f"absgrad requires projection 'ray', not {options.projection!r}; leave it out")
    dtype, device = gaussians.means.dtype, gaussians.means.device
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"means has dtype {dtype}; renderers take torch.float32 or torch.float64")
    for name, (tensor, shape) in shapes.items():
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{name} is a {type(tensor).__name__}; it must be a tensor of shape {shape}")
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}; with {count} means it must be {shape}")
        if tensor.dtype != dtype:
            raise ValueError(f"{name} has dtype {tensor.dtype} but means has {dtype}; convert one of them")
        if tensor.device != device:
            raise ValueError(f"{name} is on {tensor.device} but means is on {device}; move one of them")
    check_camera(request.camera, options)


def check_camera(camera: Camera, options: RenderOptions) -> None:
    """Refuse by ValueError a camera without pixels, or one that the projection or the bounds do not support."""
    if isinstance(camera, RayTable) and (camera.table.ndim != 3 or camera.table.shape[2] != 3):
        raise ValueError(f"the ray table has shape {tuple(camera.table.shape)}; it must be (height, width, 3)")
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"image size is {camera.width}x{camera.height}; both sides must be at least 1 pixel")
    if isinstance(camera, Pinhole) and not (camera.fx > 0 and camera.fy > 0):
        raise ValueError(f"the pinhole has focal lengths {camera.fx}, {camera.fy}; both must be > 0 pixels")
    if isinstance(camera, RayTable) and not camera.focal > 0:
        raise ValueError(f"the ray table has focal length {camera.focal}; it must be > 0 pixels per radian")
    kind = {"erp": Panorama, "pinhole": Pinhole}.get(options.projection)
    if options.cubemap:
        if not isinstance(camera, Panorama):
            raise ValueError(f"a cubemap gives a Panorama, not a {type(camera).__name__}; set cubemap=false")
    elif kind is not None and not isinstance(camera, kind):
        way_out = "; or set cubemap=true" if kind is Pinhole and isinstance(camera, Panorama) else ""
        raise ValueError(
            f"projection {options.projection!r} requires a {kind.__name__} camera, not a {type(camera).__name__}; "
            f"use tangent or ray, which take any camera{way_out}"
        )
    if options.bounds == "square" and options.projection == "ray":
        raise ValueError("projection 'ray' has no square bounds; use bounds=exact")
    whole = isinstance(camera, Panorama) and not options.cubemap
    if options.bounds == "square" and options.projection == "tangent" and not whole:
        raise ValueError(
            "projection 'tangent' has square bounds for a Panorama only; use bounds=exact with a "
            f"{'cubemap' if options.cubemap else type(camera).__name__}"
        )
