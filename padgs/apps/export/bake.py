"""Baking of PaD-GS: view-dependent anchors become explicit Gaussians, which are the same for all views.

The attributes of a decoded Gaussian differ by view; each view is weighted by the Gaussian's contribution to its image.
Opacity and covariance are weighted means; colours are spherical harmonics fitted by least squares. The result is
refined by distillation: it is trained on renders of the anchors, without photographs and test views.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from padgs.evaluation.evaluate import quantized
from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry import harmonics
from padgs.methods.anchors.anchors import PaDGS
from padgs.methods.splats.method import SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig, Rendering, RenderOptions, render
from padgs.scene import Scene, View
from padgs.training.initial_points import ExtentOptions
from padgs.training.loop import Trainer
from padgs.training.options import Budget

DEGREE = 3
FITTED_DEGREE = 1  # by least squares; higher degrees take gigabytes, and gain nothing after distillation
VIEWS = 64  # training cameras and positions between them
SPREAD = 0.3  # standard deviation of such positions from the line between two cameras, relative to its length
RIDGE = 1e-2  # regularisation of direction-dependent coefficients, relative to a Gaussian's total weight
MIN_PIXELS = 0.05  # contribution over all views below which a Gaussian is dropped
MAX_OPACITY = 0.995  # keeps logits finite
MIN_FLATNESS = 1e-4  # smallest scale of a Gaussian relative to its largest


def sample_cameras(views: Sequence[View], count: int = VIEWS) -> list[View]:
    """Return `count` cameras, always the same: at most half are given views, the rest lie between two of them."""
    random = torch.Generator().manual_seed(0)
    chosen = list(views[:: max(1, -(-len(views) // (count // 2)))])
    centers = torch.stack([view.center for view in views]).cpu()
    while len(chosen) < count:
        one, other = torch.randint(len(views), (2,), generator=random).tolist()
        line = centers[other] - centers[one]
        offset = SPREAD * line.norm() * torch.randn(3, generator=random, dtype=line.dtype)
        position = centers[one] + torch.rand((), generator=random) * line + offset
        pose = views[one].cam_from_world.clone()
        pose[:3, 3] = -pose[:3, :3] @ position.to(pose)
        chosen.append(replace(views[one].at(pose), name=f"between-{len(chosen)}"))
    return chosen


@torch.no_grad()
def bake(model: PaDGS, views: Sequence[View], options: RenderOptions, backend: str, unit: float) -> Splats:
    """Return the explicit Gaussians that fit A anchors with K Gaussians each best in these sampled views.

    Invisible Gaussians are dropped; `options` and `backend` are of the renderer, `unit` is the scene scale.
    """
    count = len(model) * model.options.offsets
    zeros = model.positions.new_zeros
    contribution, visible, covariance = zeros(count), zeros(count), zeros(count, 9)
    size = (FITTED_DEGREE + 1) ** 2
    normal, colour = zeros(count, size, size), zeros(count, size, 3)
    for view in views:
        decoded = model.decode(view)
        drawn, slots = decoded.gaussians, decoded.slots
        pixels = contributions(drawn, view, options, backend)
        contribution.index_add_(0, slots, pixels)
        within = pixels / drawn.opacities  # visible area of the footprint, in pixels
        visible.index_add_(0, slots, within)
        axes = rotation_matrices(drawn.quats) * drawn.scales[:, None]
        covariance.index_add_(0, slots, within[:, None] * (axes @ axes.mT).flatten(1))
        directions = torch.nn.functional.normalize(drawn.means - view.center.to(drawn.means), dim=-1)
        values = harmonics.basis(directions, FITTED_DEGREE)
        weighted = pixels[:, None] * values
        normal.index_add_(0, slots, weighted[:, :, None] * values[:, None])
        colour.index_add_(0, slots, weighted[:, :, None] * (drawn.colors - 0.5)[:, None])
    keep = (contribution > MIN_PIXELS).nonzero()[:, 0]
    ridge = RIDGE * torch.eye(size).to(contribution)
    ridge[0, 0] = 0
    coefficients = torch.linalg.solve(normal[keep] + contribution[keep, None, None] * ridge, colour[keep])
    scales, quats = axes_of((covariance[keep] / visible[keep, None]).view(-1, 3, 3))
    opacities = (contribution[keep] / visible[keep]).clamp(1 / 255, MAX_OPACITY)
    blank = Splats(zeros(0, 3), zeros(0, 3), zeros(0, 3), degree=DEGREE, scene_scale=unit)
    rest = zeros(len(keep), (DEGREE + 1) ** 2 - 1, 3)
    rest[:, : size - 1] = coefficients[:, 1:]
    shapes = {"means": model.centers()[keep], "quats": quats, "log_scales": scales.log()}
    blank.load(shapes | {"opacity_logits": torch.logit(opacities), "sh_dc": coefficients[:, 0], "sh_rest": rest})
    blank.active_degree = DEGREE
    return blank


def contributions(gaussians: Gaussians, view: View, options: RenderOptions, backend: str) -> Tensor:
    """Return the sums [N] of blending weights over a view: the derivatives of the image's sum by the colours."""
    with torch.enable_grad():
        colors = gaussians.colors.detach().requires_grad_()
        drawn = render(replace(gaussians, colors=colors), view, options, backend=backend)
        (gradient,) = torch.autograd.grad(drawn.image[..., 0].sum(), colors)
    return gradient[:, 0]


def axes_of(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Decompose covariances [N, 3, 3] = R diag(s)^2 R^T into scales s [N, 3] and quaternions (w, x, y, z) [N, 4]."""
    from scipy.spatial.transform import Rotation

    # On the CPU: GPUs take kilobytes per matrix, and fail for more than two million.
    squares, axes = torch.linalg.eigh(covariances.double().cpu())
    axes[:, :, 0] *= torch.linalg.det(axes)[:, None]  # right-handed
    scales = squares.clamp(min=squares[:, -1:] * MIN_FLATNESS**2).sqrt()
    quats = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat()).roll(1, -1)
    return scales.to(covariances), quats.to(covariances)


def distill(
    splats: Splats,
    render_teacher: Callable[[View], Rendering],
    scene: Scene,
    config: RenderConfig,
    steps: int,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Train splats, in place, on another model's renders of training views; `config` is the student's renderer's."""

    def target(view: View) -> View:
        pixels = cache(lambda: (quantized(render_teacher(view).image) * 255).to(torch.uint8))
        return replace(view, load_pixels=pixels, load_mask=None)

    targets = tuple(map(target, scene.train))
    fixed = SplatOptions(densify_until=0)
    student = SplatModel(splats, fixed, config, extent=ExtentOptions().extent_of(scene), iterations=steps)
    for record in Trainer(student, replace(scene, train=targets), Budget(steps)).records():
        progress(record.iteration)
