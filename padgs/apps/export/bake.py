"""PaD-GS baked: anchors, decoded anew for each view, as explicit Gaussians that are the same for all views.

What a Gaussian is seen as differs by camera; each camera counts by how much of its picture the Gaussian makes up.
Opacity and covariance become weighted means, colour the harmonics that fit the seen colours best. What then differs is
taught: the explicit Gaussians train for a while on pictures of the anchors, with no photograph and no held-out view.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from padgs.evaluation.evaluate import quantized
from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry import harmonics
from padgs.methods.anchors.model import PaDGS
from padgs.methods.splats.clone_split import CloneSplitOptions
from padgs.methods.splats.model import Splats
from padgs.methods.splats.trainee import SplatTrainee
from padgs.render import RenderConfig, Rendering, RenderOptions, render
from padgs.scene import Scene, View
from padgs.training.budget import Budget
from padgs.training.extent import ExtentOptions
from padgs.training.loop import Trainer
from padgs.training.options import TrainOptions
from padgs.training.trainee import Drawing

DEGREE = 3
FITTED_DEGREE = 1  # by least squares; equations of more take gigabytes, and gain nothing after the lessons
VIEWS = 64  # training cameras and places between them that are baked from
SPREAD = 0.3  # how far such a place lies off the line between two cameras, in distances of those
RIDGE = 1e-2  # on coefficients that depend on the direction, beside the weight of what was seen
SHOWS = 0.05  # pixels that a Gaussian must make up in all views together, or it is dropped
MOST_OPAQUE = 0.995  # logits are finite
FLATTEST = 1e-4  # smallest scale of a Gaussian, in its largest
LESSON = TrainOptions()


def cameras_around(views: Sequence[View], count: int = VIEWS) -> list[View]:
    """Up to `count` cameras: the given ones evenly chosen, and as many again or more at random places between them.

    Always the same for the same views. Those between have the turn of a given one, and no pixels.
    """
    random = torch.Generator().manual_seed(0)
    chosen = list(views[:: max(1, -(-len(views) // (count // 2)))])
    centers = torch.stack([view.center for view in views]).cpu()
    while len(chosen) < count:
        one, other = torch.randint(len(views), (2,), generator=random).tolist()
        way = centers[other] - centers[one]
        aside = SPREAD * way.norm() * torch.randn(3, generator=random, dtype=way.dtype)
        place = centers[one] + torch.rand((), generator=random) * way + aside
        pose = views[one].cam_from_world.clone()
        pose[:3, 3] = -pose[:3, :3] @ place.to(pose)
        chosen.append(replace(views[one].at(pose), name=f"between-{len(chosen)}"))
    return chosen


@torch.no_grad()
def baked(model: PaDGS, views: Sequence[View], options: RenderOptions, backend: str, unit: float) -> Splats:
    """The explicit Gaussians nearest to what these views show of the anchors; those that show in none are dropped.

    Args:
        model: the anchors, N = A K Gaussians.
        views: from where they are looked at.
        options, backend: how they are drawn.
        unit: of the scene, in world units.
    """
    count = len(model) * model.options.offsets
    zeros = model.positions.new_zeros
    shown, seen, opacity, covariance = zeros(count), zeros(count), zeros(count), zeros(count, 9)
    size = (FITTED_DEGREE + 1) ** 2
    normal, colour = zeros(count, size, size), zeros(count, size, 3)
    for view in views:
        decoded = model.decode(view)
        drawn, slots = decoded.gaussians, decoded.slots
        pixels = contributions(drawn, view, options, backend)
        shown.index_add_(0, slots, pixels)
        within = pixels / drawn.opacities  # of the Gaussian's footprint, what nothing hides
        seen.index_add_(0, slots, within)
        opacity.index_add_(0, slots, pixels)
        axes = rotation_matrices(drawn.quats) * drawn.scales[:, None]
        covariance.index_add_(0, slots, within[:, None] * (axes @ axes.mT).flatten(1))
        directions = torch.nn.functional.normalize(drawn.means - view.center.to(drawn.means), dim=-1)
        values = harmonics.basis(directions, FITTED_DEGREE)
        weighted = pixels[:, None] * values
        normal.index_add_(0, slots, weighted[:, :, None] * values[:, None])
        colour.index_add_(0, slots, weighted[:, :, None] * (drawn.colors - 0.5)[:, None])
    keep = (shown > SHOWS).nonzero()[:, 0]
    ridge = RIDGE * torch.eye(size).to(shown)
    ridge[0, 0] = 0
    coefficients = torch.linalg.solve(normal[keep] + shown[keep, None, None] * ridge, colour[keep])
    scales, quats = axes_of((covariance[keep] / seen[keep, None]).view(-1, 3, 3))
    opacities = (opacity[keep] / seen[keep]).clamp(1 / 255, MOST_OPAQUE)
    blank = Splats(zeros(0, 3), zeros(0, 3), zeros(0, 3), degree=DEGREE, unit=unit)
    rest = zeros(len(keep), (DEGREE + 1) ** 2 - 1, 3)
    rest[:, : size - 1] = coefficients[:, 1:]
    blank.load(
        {
            "means": model.centers()[keep],
            "quats": quats,
            "log_scales": scales.log(),
            "opacity_logits": torch.logit(opacities),
            "sh_dc": coefficients[:, 0],
            "sh_rest": rest,
        }
    )
    blank.active_degree = DEGREE
    return blank


def contributions(gaussians: Gaussians, view: View, options: RenderOptions, backend: str) -> Tensor:
    """How many pixels of the view each Gaussian makes up, [N]: the sum of its blending weights.

    It is the derivative of the image's sum by the Gaussian's colour.
    """
    with torch.enable_grad():
        colors = gaussians.colors.detach().requires_grad_()
        drawn = render(replace(gaussians, colors=colors), view, options, backend=backend)
        (gradient,) = torch.autograd.grad(drawn.image[..., 0].sum(), colors)
    return gradient[:, 0]


def axes_of(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Scales [N, 3] and quaternions (w, x, y, z) [N, 4] of covariances [N, 3, 3]; the inverse of R diag(s)^2 R^T."""
    from scipy.spatial.transform import Rotation

    # On the CPU, for a GPU takes kilobytes for each, and refuses more than two million.
    squares, axes = torch.linalg.eigh(covariances.double().cpu())
    axes[:, :, 0] *= torch.linalg.det(axes)[:, None]  # no mirror
    scales = squares.clamp(min=squares[:, -1:] * FLATTEST**2).sqrt()
    quats = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat()).roll(1, -1)
    return scales.to(covariances), quats.to(covariances)


class Pupil(SplatTrainee):
    """Splats that neither grow nor lose any, with all of their harmonics from the start."""

    def __init__(self, splats: Splats, config: RenderConfig, extent: float, iterations: int) -> None:
        """Learning rates are those of 3DGS for a run of `iterations`."""
        super().__init__(splats, CloneSplitOptions(), config, extent=extent, iterations=iterations)

    def observe(self, drawing: Drawing, iteration: int) -> None:
        """Nothing needs to be known."""

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Nothing grows."""
        return ()


def teach(
    splats: Splats,
    show: Callable[[View], Rendering],
    scene: Scene,
    config: RenderConfig,
    steps: int,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Train splats, in place, on pictures of another model.

    Args:
        splats: what is trained.
        show: what they shall look like.
        scene: whose training views are looked at; their photographs are not.
        config: how splats are drawn.
        steps: iterations.
        progress: called with the number of those that are done.
    """
    lessons = tuple(replace(view, load_pixels=_Picture(show, view), load_mask=None) for view in scene.train)
    pupil = Pupil(splats, config, ExtentOptions().extent_of(scene), steps)
    for record in Trainer(pupil, replace(scene, train=lessons), Budget(steps), LESSON).records():
        progress(record.iteration)


class _Picture:
    """The pixels of a view as a model shows it, [H, W, 3] uint8, drawn when they are first asked for."""

    def __init__(self, show: Callable[[View], Rendering], view: View) -> None:
        self._show, self._view, self._pixels = show, view, None

    def __call__(self) -> Tensor:
        if self._pixels is None:
            self._pixels = (quantized(self._show(self._view).image) * 255).to(torch.uint8)
        return self._pixels
