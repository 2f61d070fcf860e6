"""Initial Gaussians beyond the point cloud: training pixels with estimated depth, and far Gaussians.

Numbers of points and Gaussians are multiples of `solid_angle_pixels` times `room_count`.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from padgs.geometry.camera import Panorama
from padgs.geometry.panorama import sample
from padgs.methods.splats.splats import Splats
from padgs.scene import Scene, View
from padgs.training.targets import depth_of, even_weight, image_of

NEIGHBOURS = 4  # points that a depth is interpolated from
MAX_SOURCE_VIEWS = 64  # training views that pixels are taken from, evenly spread
MIN_ANGLE = 1e-3  # radians; nearer points all get the weight of this angle

SWEEP_VIEWS = 4  # views that are compared; the better half counts, for the others may be occluded
SWEEP_STEPS = 13  # inverse depths, log-spaced between those of the points around
SWEEP_MARGIN = 1.2  # factor beyond the smallest and the largest of them
PATCH = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))  # pixels across and along
OCTAVE_COST = 0.01  # of the range of colours: required gain for a depth an octave away from the interpolated one
MIN_PARALLAX = 1e-3  # of the median depth; a camera that moved by less gives no parallax
CHUNK = 4096  # pixels at once, which bounds memory

COVERED_SPACINGS = 2.0  # a point covers directions within so many spacings of directions, or of points if wider
FAR_FACTOR, FAR_QUANTILE = 3.0, 0.99  # far Gaussians are at this factor times this quantile of distances

ROOM_POINTS, ROOM_VIEWS = 10_000, 16  # at most, for `room_count`
POINTS_PER_BIN = 16  # of directions, on average
SURFACE_RANK = 3  # the nearest points of a bin may float; this one is on a surface
OCCLUSION_FACTOR = 1.5  # a point farther than so many times the surface is occluded
SINGLE_ROOM = 1.3  # inverse visible share in one room, because of furniture
MIN_PIXELS = 2000.0  # panoramas below 80x40: many of them together show more than each


def solid_angle_pixels(view: View) -> float:
    """Return the independent pixels of a panorama, W H 2 / pi, at least `MIN_PIXELS`; of a photograph by its share."""
    if view.sphere_share < 1:
        return 4 * math.pi * view.camera.focal**2 * view.sphere_share
    return max(MIN_PIXELS, 2 * view.width * view.height / math.pi)


def fill_sparse_cloud(scene: Scene, count: int, *, generator: torch.Generator, measured: bool = False) -> Scene:
    """Return the scene with training pixels added as points, up to `count` points.

    Pixels are sampled by solid angle and mask. Their depth is interpolated from the cloud as that view sees it
    (Shepard: inverse depth, weights 1 / angle^2, so that planes stay planes) and refined by `plane_sweep`. A pixel
    farther from all points than the points' spacing is dropped: it may show the sky. Points that are not finite or at a
    camera centre are ignored. `measured`: take depths from the depth maps of views that have one.
    """
    missing = count - len(scene.points)
    cloud = scene.points[torch.isfinite(scene.points).all(-1)].double().cpu()
    if missing <= 0 or len(cloud) == 0:
        return scene
    panoramas = scene.panoramas
    views = panoramas[:: math.ceil(len(panoramas) / MAX_SOURCE_VIEWS)]
    per_view = math.ceil(missing / len(views))
    parts = [_pixels_as_points(view, cloud, per_view, generator, scene.train, measured) for view in views]
    points, colors = (torch.cat(part) for part in zip(*parts, strict=True))
    return replace(
        scene,
        points=torch.cat((scene.points, points.to(scene.points))),
        point_colors=torch.cat((scene.point_colors, colors.to(scene.point_colors))),
    )


def _pixels_as_points(
    view: View, cloud: Tensor, count: int, generator: torch.Generator, others: Sequence[View], measured: bool
) -> tuple[Tensor, Tensor]:
    """Return at most `count` pixels of a view as points [n, 3] float64 world, and their colours [n, 3] uint8."""
    weight = even_weight(view, torch.device("cpu")).double().expand(view.height, view.width).reshape(-1)
    cumulative = weight.cumsum(0)  # torch.multinomial is limited to 2^24 weights
    chosen = torch.rand(count, dtype=torch.float64, generator=generator) * cumulative[-1]
    pixels = torch.searchsorted(cumulative, chosen, right=True).clamp(max=len(cumulative) - 1)
    rays, pose = view.camera.rays(dtype=torch.float64).reshape(-1, 3)[pixels], view.cam_from_world.double().cpu()
    if measured and (depth := depth_of(view)) is not None:
        inverse_depth = 1 / depth.double().reshape(-1)[pixels]
        near = inverse_depth.isfinite() & (inverse_depth > 0)
        inverse_depth = inverse_depth[near]
    else:
        near, inverse_depth = _interpolated(view, cloud @ pose[:3, :3].T + pose[:3, 3], rays, others)
    camera_frame = rays[near] / inverse_depth[:, None]
    colors = image_of(view, torch.device("cpu")).reshape(-1, 3)[pixels[near]]
    return (camera_frame - pose[:3, 3]) @ pose[:3, :3], (255 * colors).round().to(torch.uint8)


def _interpolated(view: View, cloud: Tensor, rays: Tensor, others: Sequence[View]) -> tuple[Tensor, Tensor]:
    """Return which rays [n] are near a point of the cloud [P, 3], camera frame, and their inverse depths."""
    from scipy.spatial import KDTree

    distances = cloud.norm(dim=-1)
    elsewhere = distances > 0
    directions, inverse = (cloud / distances[:, None])[elsewhere], 1 / distances[elsewhere]
    if len(directions) == 0:
        return torch.zeros(len(rays), dtype=torch.bool), distances[:0]
    spacing = math.sqrt(4 * math.pi / len(directions))
    nearest = KDTree(directions.numpy()).query(rays.numpy(), k=min(NEIGHBOURS, len(directions)))
    angles, neighbours = (torch.as_tensor(part).reshape(len(rays), -1) for part in nearest)
    near = (angles < spacing).any(-1)
    weights = 1 / angles[near].clamp(min=MIN_ANGLE).square()
    inverse_depth = (weights * inverse[neighbours[near]]).sum(-1) / weights.sum(-1)
    return near, plane_sweep(view, rays[near], inverse_depth, inverse[neighbours[near]], others)


def plane_sweep(view: View, rays: Tensor, inverse_depth: Tensor, around: Tensor, views: Sequence[View]) -> Tensor:
    """Return inverse depths [n] of pixels at which nearby views agree best in colour (plane sweep, Collins 1996).

    `rays` [n, 3] float64 are those of the pixels in the frame of the `view`, `inverse_depth` [n] > 0 is the initial
    estimate, 1 / world units, and `around` [n, K] > 0 are those of points around, which bound the candidates. Views
    that are no panoramas or have no parallax are skipped, and masks ignored; for other cameras nothing is changed.
    """
    if not isinstance(view.camera, Panorama) or len(rays) == 0:
        return inverse_depth
    least = MIN_PARALLAX / inverse_depth.median().item()
    panoramas = [other for other in views if isinstance(other.camera, Panorama)]
    baselines = [float((view.center - other.center).norm()) for other in panoramas]
    order = sorted((number for number, base in enumerate(baselines) if base > least), key=lambda n: baselines[n])
    others = [panoramas[number] for number in order[:SWEEP_VIEWS]]
    if not others:
        return inverse_depth
    chunks = zip(*(tensor.split(CHUNK) for tensor in (rays, inverse_depth, around)), strict=True)
    images = [image_of(other, torch.device("cpu")) for other in (view, *others)]
    return torch.cat([_sweep_chunk(view, others, images, *chunk) for chunk in chunks])


def _sweep_chunk(
    view: View, others: Sequence[View], images: Sequence[Tensor], rays: Tensor, inverse_depth: Tensor, around: Tensor
) -> Tensor:
    low, high = around.amin(1, keepdim=True) / SWEEP_MARGIN, around.amax(1, keepdim=True) * SWEEP_MARGIN
    steps = low * (high / low) ** torch.linspace(0, 1, SWEEP_STEPS, dtype=low.dtype)
    candidates = torch.cat((inverse_depth[:, None], steps), dim=1)  # [n, R]
    patch = _patch(rays, 2 * math.pi / view.width)  # [n, P, 3]
    own = sample(images[0], patch.float())
    points = (patch[:, None] / candidates[:, :, None, None]).float()  # [n, R, P, 3] camera frame of the view
    costs = []
    for other, image in zip(others, images[1:], strict=True):
        other_from_view = (other.cam_from_world.double() @ view.cam_from_world.double().inverse()).float().cpu()
        seen = sample(image, points @ other_from_view[:3, :3].T + other_from_view[:3, 3])
        costs.append((seen - own[:, None]).abs().mean((-1, -2)).double())  # [n, R]
    better = torch.stack(costs).sort(0).values[: math.ceil(len(others) / 2)]
    cost = better.mean(0) + OCTAVE_COST * (candidates / inverse_depth[:, None]).log2().abs()
    return candidates.gather(1, cost.argmin(1, keepdim=True))[:, 0]


def _patch(rays: Tensor, pixel: float) -> Tensor:
    """Return directions [n, P, 3] of a patch around rays [n, 3]; `pixel` in radians."""
    helper = torch.eye(3, dtype=rays.dtype)[rays.abs().argmin(-1)]  # the axis that is furthest from a ray
    across = functional.normalize(torch.linalg.cross(rays, helper), dim=-1)
    along = torch.linalg.cross(rays, across)
    directions = [rays + pixel * (a * across + b * along) for a, b in PATCH]
    return functional.normalize(torch.stack(directions, dim=1), dim=-1)


def far_gaussians(scene: Scene, count: int, *, degree: int, opacity: float) -> Splats:
    """Return far grey Gaussians in those of `count` even directions that no point covers, such as the sky.

    Directions are seen from the median camera centre; neighbours touch. A room that covers all of them gets none.
    """
    from scipy.spatial import KDTree

    centre = torch.stack([view.center for view in scene.train]).median(0).values
    rays = scene.points.double() - centre.to(scene.points).double()
    distances = rays.norm(dim=-1)
    seen = (rays / distances[:, None])[distances > 0]
    spacing = math.sqrt(4 * math.pi / count)
    reach = COVERED_SPACINGS * max(spacing, math.sqrt(4 * math.pi / len(seen)))
    directions = fibonacci_sphere(count)
    nearest, _ = KDTree(seen.cpu().numpy()).query(directions.numpy(), distance_upper_bound=reach)
    free = directions[torch.from_numpy(nearest).isinf()].to(rays)
    far = FAR_FACTOR * distances[:: max(1, len(distances) // 20_000)].quantile(FAR_QUANTILE).item()
    means = (centre.to(free) + far * free).to(scene.points)
    log_scales = torch.full_like(means, math.log(0.5 * spacing * far))
    grey = torch.full_like(means, 0.5)
    return Splats(means, log_scales, grey, degree=degree, scene_scale=scene.scale, opacity=opacity)


def fibonacci_sphere(count: int) -> Tensor:
    """Return evenly spread unit vectors [count, 3] float64: equal steps of height, the golden angle around."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    radius = (1 - height * height).clamp(min=0).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height), dim=-1)


def room_count(scene: Scene) -> float:
    """Return how many single rooms the points of a scene would fill, at least 1; several rooms are underestimated.

    In a single room a view sees nearly all points; rooms are the inverse of the mean share that a view sees.
    """
    points = scene.points[:: max(1, -(-len(scene.points) // ROOM_POINTS))].double()
    points = points[points.isfinite().all(1)]
    if len(points) == 0:
        return 1.0  # the initialisation reports the empty cloud
    views = scene.panoramas[:: -(-len(scene.panoramas) // ROOM_VIEWS)]
    visible = sum(visible_points(points, view).double().mean().item() for view in views) / len(views)
    return max(1.0, 1 / (SINGLE_ROOM * visible))


def visible_points(points: Tensor, view: View, factor: float = OCCLUSION_FACTOR) -> Tensor:
    """Return which points [N, 3] are nearer than `factor` times the surface, by bins of equal solid angle, [N] bool."""
    toward = points - view.center.to(points)
    distance = toward.norm(dim=-1)
    rows = max(6, round(math.sqrt(len(points) / POINTS_PER_BIN / 2)))  # by the cosine of the angle from world z
    height = toward[:, 2] / distance.clamp(min=torch.finfo(distance.dtype).tiny)
    row = ((height + 1) / 2 * rows).long().clamp(0, rows - 1)
    column = ((torch.atan2(toward[:, 1], toward[:, 0]) / math.pi + 1) * rows).long().clamp(0, 2 * rows - 1)
    cell = 2 * rows * row + column
    order = torch.argsort(distance)
    order = order[torch.argsort(cell[order], stable=True)]  # by cell, the nearest first
    count = torch.bincount(cell, minlength=2 * rows * rows)
    first = count.cumsum(0) - count
    surface = (first + (count - 1).clamp(0, SURFACE_RANK - 1)).clamp(max=len(points) - 1)
    limit = factor * distance[order[surface]]
    return distance <= limit[cell]
