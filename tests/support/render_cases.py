"""Difficult Gaussians, cameras, poses, engines (backend, dtype), and comparisons for tests of rendering."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable
from padgs.geometry.panorama import direction
from padgs.native import cpu
from padgs.render import BACKENDS, Rendering, RenderOptions, render
from padgs.render.contract import ALPHA_MIN, Request
from padgs.render.projection import Footprints, PlanarFootprints, project
from padgs.render.projective import RayFootprints
from padgs.scene import View
from support import cuda_engine

INPUTS = ("means", "quats", "scales", "opacities", "colors")
OUTPUTS = ("image", "transmittance", "depth")
KINDS = ("ordinary", "polar", "pole", "seam", "near", "huge", "needle")
ODD_SIZES = ((72, 36), (70, 44), (33, 17))
RELEASED = RenderOptions(near=0.2, wrap=False, bounds="square")  # as conf/render/released.yaml, one world unit
SETUPS = (  # every projection with every camera that it takes
    ("erp", "panorama"),
    ("tangent", "panorama"),
    ("ray", "panorama"),
    ("pinhole", "pinhole"),
    ("tangent", "pinhole"),
    ("ray", "pinhole"),
    ("tangent", "fisheye"),
    ("ray", "fisheye"),
)


def engines() -> list:
    """Return all backends with all their dtypes as pytest parameters `backend, dtype`."""
    found = []
    for backend in BACKENDS:
        for dtype in (torch.float64, torch.float32) if backend == "torch" else (torch.float32,):
            marks = cuda_engine.marks() if backend == "cuda" else []
            if backend == "cpu":
                marks.append(pytest.mark.skipif(not cpu.available(), reason="the native library is not built"))
            found.append(pytest.param(backend, dtype, id=f"{backend}-{str(dtype)[-2:]}", marks=marks))
    return found


each_engine = pytest.mark.parametrize(("backend", "dtype"), engines())
each_native_engine = pytest.mark.parametrize(
    "backend",
    [pytest.param(e.values[0], marks=e.marks, id=e.values[0]) for e in engines() if e.values[0] != "torch"],
)
needs_native = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")
each_setup = pytest.mark.parametrize(("projection", "lens"), SETUPS, ids=["-".join(setup) for setup in SETUPS])
each_panorama = pytest.mark.parametrize("projection", ("erp", "tangent", "ray"))


def projected(gaussians: Gaussians, cam_from_world: Tensor, camera: Camera, options: RenderOptions) -> Footprints:
    """Return the footprints of the torch backend."""
    return project(Request(gaussians, cam_from_world, camera, options, background=gaussians.means.new_zeros(3)))


def camera_of(lens: str, width: int, height: int) -> Camera:
    """Return a panorama, an asymmetric pinhole, or a ray table: a fisheye of 240 degrees across its width."""
    if lens == "panorama":
        return Panorama(width, height)
    pinhole = Pinhole(width, height, 0.5 * width, 0.45 * width, 0.46 * width, 0.55 * height)
    if lens == "pinhole":
        return pinhole
    focal = width / math.radians(240)
    x = (torch.arange(width, dtype=torch.float64) + 0.5 - pinhole.cx) / focal
    y = (torch.arange(height, dtype=torch.float64) + 0.5 - pinhole.cy) / focal
    angle = torch.hypot(x[None], y[:, None])
    table = torch.stack(
        (torch.sinc(angle / math.pi) * x, torch.sinc(angle / math.pi) * y[:, None], angle.cos()), dim=-1
    )
    return RayTable(table.float().double(), focal)


def gaussians_of(kind: str, count: int, generator: torch.Generator) -> Gaussians:
    """Return random Gaussians around a camera at the origin, float64 but exactly representable in float32.

    ordinary: anywhere; polar: 0.2 to 15 degrees from a pole; pole: broad, covering it; seam: across longitude 180;
    near: centimetres away where the others are metres; huge: one to five times as broad as far away; needle: 100 times
    as long as thick.
    """

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    longitude = uniform(-math.pi, math.pi, count)
    latitude = torch.asin(uniform(-0.95, 0.95, count))
    radius, size = uniform(1, 4, count), uniform(0.02, 0.15, count, 3)
    colatitude = None
    if kind == "polar":
        colatitude = torch.deg2rad(uniform(0.2, 15, count))
    elif kind == "pole":
        size = uniform(0.05, 0.4, count, 3)
        colatitude = size.mean(-1) * uniform(0.1, 1.5, count)
    elif kind == "seam":
        longitude = math.pi + uniform(-0.08, 0.08, count)
    elif kind == "near":
        radius, size = uniform(0.002, 0.05, count), uniform(0.1, 0.6, count, 3)
    elif kind == "huge":
        size = uniform(1, 5, count, 3)
    elif kind == "needle":
        size = torch.tensor([0.2, 0.002, 0.002], dtype=torch.float64).expand(count, 3)
    if colatitude is not None:
        latitude = (math.pi / 2 - colatitude) * torch.sign(uniform(-1, 1, count))
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64) + 1e-3
    gaussians = Gaussians(
        means=radius[:, None] * direction(longitude, latitude),
        quats=quats,
        scales=size * radius[:, None],
        opacities=uniform(0.05, 0.95, count),
        colors=uniform(0, 1, count, 3),
    )
    return gaussians.to(torch.float32).to(torch.float64)


def joined(*parts: Gaussians) -> Gaussians:
    """Concatenate sets of Gaussians."""
    return Gaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name in INPUTS})


def chosen(gaussians: Gaussians, which: Tensor | slice) -> Gaussians:
    """Return a subset of the Gaussians."""
    return Gaussians(**{name: getattr(gaussians, name)[which] for name in INPUTS})


def mixture(count_of_each: int, generator: torch.Generator, kinds: tuple[str, ...] = KINDS) -> Gaussians:
    """Return some Gaussians of every kind."""
    return joined(*(gaussians_of(kind, count_of_each, generator) for kind in kinds))


def identity_pose() -> Tensor:
    return torch.eye(4, dtype=torch.float64)


def random_pose(generator: torch.Generator, shift: float = 0.0) -> Tensor:
    """Return a rigid pose [4, 4] float64, representable in float32."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrices(torch.randn(4, generator=generator, dtype=torch.float64))
    pose[:3, 3] = shift * torch.randn(3, generator=generator, dtype=torch.float64)
    return pose.float().double()


def view_of(camera: Camera, pose: Tensor | None = None) -> View:
    """Return a view without an image."""
    return View("test", identity_pose() if pose is None else pose, camera.width, camera.height, lens=camera)


def draw(
    gaussians: Gaussians,
    width: int,
    height: int,
    *,
    backend: str,
    dtype: torch.dtype,
    lens: str = "panorama",
    pose: Tensor | None = None,
    options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
    **more,
) -> Rendering:
    """Render with one engine; the pose may require a gradient."""
    more = {name: value.to(dtype) if isinstance(value, Tensor) else value for name, value in more.items()}
    view = view_of(camera_of(lens, width, height), pose)
    return render(gaussians.to(dtype), view, options=options, backend=backend, **more)


def leaves(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    """Return a copy whose tensors require gradients."""
    return Gaussians(
        **{name: getattr(gaussians, name).detach().to(dtype, copy=True).requires_grad_() for name in INPUTS}
    )


def stable_pixels(
    gaussians: Gaussians,
    width: int,
    height: int,
    *,
    lens: str | Camera = "panorama",
    pose: Tensor | None = None,
    options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
    margin: float = 1e-3,
) -> Tensor:
    """Return pixels [H, W] bool that are far from any decision: the image is smooth there and rounding flips nothing.

    A decision is near where an alpha is within `margin` (relative) of 1/255 or 0.99; for a chart footprint broader than
    half a turn, where the pixel is within `margin` pixels of the longitude opposite to the mean; for `ray`, where the
    ray meets a Gaussian within `margin` (relative) of the near radius.
    """
    pose = identity_pose() if pose is None else pose
    camera = camera_of(lens, width, height) if isinstance(lens, str) else lens
    footprints = projected(gaussians, pose.to(gaussians.means.dtype), camera, options)
    everything = torch.arange(len(gaussians))[footprints.visible]
    pixels = torch.arange(height * width)
    rows, columns = pixels // width, pixels % width
    q, _ = footprints.squared_distance(everything, rows, columns)
    alpha = footprints.opacities[everything] * torch.exp(-0.5 * q)
    unstable = ((alpha / ALPHA_MIN - 1).abs() < margin) | ((alpha / 0.99 - 1).abs() < margin)
    if isinstance(footprints, PlanarFootprints) and footprints.turn < torch.inf:
        across = ((columns[:, None] + 0.5 - footprints.centers[everything, 0] + width / 2) % width).abs()
        unstable |= (torch.minimum(across, width - across) < max(margin, 1e-3)) & (alpha >= ALPHA_MIN / 2)
    if isinstance(footprints, RayFootprints):
        closer, further = (
            replace(footprints, near=options.near * factor).squared_distance(everything, rows, columns)[1]
            for factor in (1 - margin, 1 + margin)
        )
        unstable |= closer & ~further & (alpha >= ALPHA_MIN / 2)
    after = torch.cumprod(1 - alpha.clamp(max=0.99)[..., torch.argsort(footprints.depths[everything])], dim=-1)
    unstable |= (after / 1e-4 - 1).abs() < max(margin, 1e-2)
    return ~unstable.any(-1).view(height, width)


def row_error(actual: Tensor, expected: Tensor) -> float:
    """Return the largest error of a gradient by rows: max |g - e| / (|e| + 1e-3 E), E the largest row."""
    actual, expected = actual.double(), expected.double()
    if actual.ndim == 1:
        actual, expected = actual[:, None], expected[:, None]
    norms = expected.norm(dim=-1)
    largest = norms.max()
    if largest == 0:
        return actual.abs().max().item()
    return ((actual - expected).abs().amax(-1) / (norms + 1e-3 * largest)).max().item()


def blended(blending: str, core_size: int) -> dict:
    """Return options of a blending, with the core size if it has a core."""
    return {"blending": blending} | ({"core_size": core_size} if blending == "hybrid" else {})


def differentiated(
    gaussians: Gaussians,
    camera: Camera,
    options: RenderOptions,
    weights: Tensor,
    *,
    backend: str,
    dtype: torch.dtype,
    pose: Tensor | None = None,
) -> tuple[Rendering, dict[str, Tensor]]:
    """Return a rendering and the gradients of the sum of its outputs times weights [H, W, 3 to 5] by every input.

    The gradient of the pose is by a rotation and a shift, [2, 3]: three of the nine entries of a rotation are free.
    """
    inputs, pose = leaves(gaussians, dtype), (identity_pose() if pose is None else pose).to(dtype, copy=True)
    background = torch.tensor([0.3, 0.6, 0.9], dtype=dtype, requires_grad=True)
    extra = {"background": background, "mean_offsets": torch.zeros(len(gaussians), 2, dtype=dtype, requires_grad=True)}
    variables = {**vars(inputs), **extra, "pose": pose.requires_grad_()}
    if isinstance(camera, RayTable):
        variables["rays"] = camera.table.to(dtype, copy=True).requires_grad_()
        camera = RayTable(variables["rays"], camera.focal)
    rendering = render(inputs, view_of(camera, pose), options, backend=backend, **extra)
    outputs = torch.cat((rendering.image, rendering.transmittance[..., None], rendering.depth[..., None]), dim=-1)
    (outputs[..., : weights.shape[-1]] * weights.to(dtype)).sum().backward()
    gradients = {name: variable.grad for name, variable in variables.items()}
    turn = gradients["pose"][:3, :3] @ pose.detach()[:3, :3].T
    turn = turn - turn.T
    gradients["pose"] = torch.stack((torch.stack((turn[2, 1], turn[0, 2], turn[1, 0])), gradients["pose"][:3, 3]))
    return rendering, gradients


def definition(
    gaussians: Gaussians,
    camera: Camera,
    options: RenderOptions,
    stable: Tensor,
    generator: torch.Generator,
    pose: Tensor | None = None,
) -> tuple[Tensor, Rendering, dict[str, Tensor]]:
    """Return random weights [H, W, 5] of stable pixels, and what `differentiated` returns for the definition."""
    weights = torch.randn(*stable.shape, 5, generator=generator, dtype=torch.float64) * stable[..., None]
    drawn = differentiated(gaussians, camera, options, weights, pose=pose, backend="torch", dtype=torch.float64)
    return weights, *drawn


def assert_matches_definition(
    gaussians: Gaussians,
    camera: Camera,
    options: RenderOptions,
    stable: Tensor,
    defined: tuple[Tensor, Rendering, dict[str, Tensor]],
    *,
    backend: str,
    dtype: torch.dtype = torch.float32,
    pose: Tensor | None = None,
    slack: float = 1,
    depth_tolerance: float = 1e-5,
) -> None:
    """Compare values and gradients by every input with the `definition` on stable pixels [H, W]."""
    weights, expected, expected_gradients = defined
    actual, gradients = differentiated(gaussians, camera, options, weights, pose=pose, backend=backend, dtype=dtype)
    if options.projection in ("erp", "pinhole"):
        assert torch.equal(actual.visible, expected.visible)
    else:  # the definition has no bounds: visible Gaussians may lie outside the image
        assert not (actual.visible & ~expected.visible).any()
    for name, absolute, relative in (("image", 2e-5, 0), ("transmittance", 2e-5, 0), ("depth", 0, depth_tolerance)):
        output, truth = (getattr(rendering, name)[stable].double() for rendering in (actual, expected))
        torch.testing.assert_close(
            output, truth, atol=slack * absolute, rtol=slack * relative, msg=lambda text, n=name: f"{n}: {text}"
        )
    pairs = [rendering.counters["contributing"] for rendering in (actual, expected)]
    assert abs(pairs[0] - pairs[1]) <= 8 * int((~stable).sum())
    for name, gradient in expected_gradients.items():
        assert gradient.any(), f"{name} has no gradient to compare"
        if name == "rays":  # a row is a pixel here, and faint pixels have few digits
            assert (gradients[name] - gradient).abs().max() < slack * 2e-3 * gradient.norm(dim=-1).max()
        else:
            assert row_error(gradients[name], gradient) < slack * 2e-3, name
