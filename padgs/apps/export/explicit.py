"""Conversion of runs to explicit Gaussians, and similarity transforms of explicit Gaussians."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import torch
from torch import Tensor

import padgs
from padgs.apps.export.bake import bake, distill, sample_cameras
from padgs.data.camera_paths import gravity
from padgs.data.capture import DataError
from padgs.evaluation.evaluate import evaluate
from padgs.evaluation.protocols import PROTOCOLS
from padgs.geometry import harmonics
from padgs.geometry.similarity import Similarity
from padgs.methods.anchors.method import AnchorModel
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.smoothing_filter import cameras_of, finest_pixels, widened
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig, Rendering, render
from padgs.runs.load import LoadedRun
from padgs.scene import View

DISTILLATION_STEPS = 300
UNSMOOTHED = "--smooth changes nothing: the method has no 3D filter, or it is in the scales already"
UP = (0.0, -1.0, 0.0)  # in most viewers of 3DGS files, as in most structure from motion
AXES = "axes and units of the scene; its cameras look along z, x is right, y down"


@dataclass(frozen=True)
class Exported:
    """Explicit Gaussians of a run, and notes about them."""

    splats: Splats
    notes: tuple[str, ...]  # one per line
    start: Tensor | None  # [2, 3] initial position and target for viewers, of the central camera; None if unknown


def export_run(
    run: LoadedRun,
    *,
    distillation_steps: int = DISTILLATION_STEPS,
    upright: bool = False,
    smooth: bool = False,
    crop: Sequence[float] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Exported:
    """Convert a run of any method with Gaussians to explicit ones, in the world of its scene.

    Its data set is needed, unless the Gaussians are written as trained. Baked anchors are trained on renders of the run
    for `distillation_steps`, which `progress` is told. `upright` rotates the world so that the cameras' up is -y, as
    viewers expect; `smooth` includes the 3D filter (`padgs.methods.splats.smoothing_filter`) in the scales, if there is
    one, as viewers have none; `crop` are lowest and highest x y z of the means that are kept.
    """
    model = run.method.model
    config = run.config.render
    notes = [f"padgs {padgs.__version__}, run {run.folder.name}"]
    if isinstance(model, SplatModel):
        splats, world, as_trained = model.baked(), run.method.world, "Gaussians as trained"
        if config.steepness:
            splats, as_trained = _as_gaussians(run, splats, distillation_steps, progress)
        elif world is not None:
            splats = transform_splats(splats, world.inverse())
        if smooth and config.low_pass > 0 and config.resolved_low_pass_kind == "solid":
            # Square pixels, also after training with several samples: for viewers with one, this is nearer to the run.
            pixels = finest_pixels(splats.means, cameras_of(run.scene.train))
            splats, smooth = widened(splats, config.low_pass * pixels.square()), False
            as_trained += ", including the 3D smoothing filter"
        notes.append(as_trained)
        if distillation_steps != DISTILLATION_STEPS and not config.steepness:
            notes.append("--distillation-steps changes nothing: the Gaussians are written as trained")
    elif isinstance(model, AnchorModel):
        means, world = model.anchors.centers().double(), run.method.world
        _inside(means if world is None else world.inverse()(means), crop)  # before the long work
        options, views = config.options(run.scene.scale), _views_of_model(run)
        splats = bake(model.anchors, views, options, config.backend, run.scene.scale)
        words = f"baked: {len(splats)} of {run.method.size().counts['gaussians']} Gaussians are visible"
        splats, loss = _fitted(run, splats, config, distillation_steps, progress)
        notes.append(f"{words}; {loss}")
    else:
        raise ValueError(f"{run.config.method} has no Gaussians to export; use padgs render or padgs view")
    if smooth:
        notes.append(UNSMOOTHED)
    if (inside := _inside(splats.means, crop)) is not None:
        notes.append(f"cropped to {int(inside.sum())} of {len(splats)} Gaussians")
        splats = deepcopy(splats)
        splats.load({name: rows[inside] for name, rows in splats.rows().items()})
    kind = f"a low-pass of {config.low_pass:g} in {config.resolved_low_pass_kind}"
    kind += f" and {config.supersampling**2} samples a pixel" if config.supersampling > 1 else ""
    notes.append(f"trained with projection {config.projection}, {kind}; those of viewers differ")
    notes.append(AXES)
    try:
        scene = run.scene
    except DataError:
        if upright:
            raise
        notes.append("the data set is missing; its origin in this world is unknown")
        return Exported(splats, tuple(notes), None)
    if scene.origin.any():
        origin = " ".join(f"{number:.10g}" for number in scene.origin.tolist())
        notes.append(f"the origin is at {origin} in the world of the data set, which is too far away for float32")
    centres = torch.stack([view.center.double().cpu() for view in scene.train])
    central = int((centres - centres.mean(0)).norm(dim=-1).argmin())
    ahead = scene.train[central].cam_from_world[2, :3].double().cpu()
    start = torch.stack((centres[central], centres[central] + scene.scale * ahead))
    if upright:
        up = torch.tensor(gravity(torch.stack([view.cam_from_world for view in scene.panoramas])).up)
        rotation = Similarity.turning(up, UP)
        splats, start = transform_splats(splats, rotation), rotation(start)
        notes[notes.index(AXES)] = "units of the scene, rotated so that -y is up"
    elif gravity(torch.stack([view.cam_from_world for view in scene.panoramas])).axis == "+z":
        notes.append("Vertical Axis: z")  # as in files of nerfstudio; `padgs view` reads it
    return Exported(splats, tuple(notes), start)


def _inside(means: Tensor, crop: Sequence[float] | None) -> Tensor | None:
    """Return which means [N, 3] lie in a box, [N] bool; None without a box, and a ValueError if none does."""
    if crop is None:
        return None
    low, high = means.new_tensor(crop).view(2, 3)
    if (inside := ((means >= low) & (means <= high)).all(-1)).any():
        return inside
    box = f"the box from {low.tolist()} to {high.tolist()}"
    there = f"they are from {means.min(0).values.tolist()} to {means.max(0).values.tolist()}"
    raise ValueError(f"no Gaussian lies in {box}; {there}, in the world of `padgs view`: change --crop")


def _views_of_model(run: LoadedRun) -> list[View]:
    """Return cameras among the training views, in the world of the model."""
    views, world = sample_cameras(run.scene.train), run.method.world
    return views if world is None else [view.at(world.pose(view.cam_from_world)) for view in views]


def _as_gaussians(run: LoadedRun, splats: Splats, steps: int, progress: Callable[[int], None]) -> tuple[Splats, str]:
    """Return Gaussians for splats with a steeper response (`RenderOptions.steepness`), and what they lose.

    Each covers the same area, weighted by its response, as before; then they are fitted to renders of the run.
    """
    config, splats = run.config.render, deepcopy(splats)
    s = torch.tensor(config.steepness, dtype=torch.float64)
    # Half the integral of exp(-((1 - s) q + s q^2) / 2) over q: 1 for a Gaussian.
    area = (torch.pi / (8 * s)).sqrt() * torch.special.erfcx((1 - s) / (8 * s).sqrt())
    splats.load(splats.rows() | {"log_scales": splats.log_scales.detach() + area.sqrt().log().item()})
    try:
        _ = run.scene
    except DataError:
        world = run.method.world
        return splats if world is None else transform_splats(splats, world.inverse()), "Gaussians of equal area"
    splats, loss = _fitted(run, splats, replace(config, steepness=0.0, supersampling=1), steps, progress)
    return splats, f"Gaussians for a kernel of steepness {config.steepness:g}; {loss}"


def _fitted(
    run: LoadedRun, splats: Splats, config: RenderConfig, steps: int, progress: Callable[[int], None]
) -> tuple[Splats, str]:
    """Fit Gaussians in the world of the model to its renders; return them in that of the scene, and what they lose."""
    scene, method, options = run.scene, run.method, config.options(run.scene.scale)
    if steps:  # on ideal renders
        views = tuple(_views_of_model(run))
        distill(splats, method.model.render, replace(scene, train=views), config, steps, progress)
    if method.world is not None:
        splats = transform_splats(splats, method.world.inverse())

    def render_splats(view: View) -> Rendering:
        drawn = render(splats.gaussians(view), view, options, backend=config.backend)
        return method.photographed(drawn, view)

    kind = "test" if scene.test else "training"
    protocol = replace(PROTOCOLS["sphere"], lpips="none", metrics=("ws_psnr",))
    before, after = (
        evaluate(render_view, scene.test or scene.train, protocol).metrics["ws_psnr"] or 0
        for render_view in (method.render, render_splats)
    )
    change = f"{abs(after - before):.2f} dB {'below' if after < before else 'above'} the run's {before:.2f} dB"
    return splats, f"WS-PSNR of the {kind} views {after:.2f} dB, {change}"


@torch.no_grad()
def transform_splats(splats: Splats, new_from_old: Similarity) -> Splats:
    """Apply a similarity transform to Gaussians, including the directions of their colours."""
    from scipy.spatial.transform import Rotation

    rotation = new_from_old.rotation.to(splats.sh_dc)
    quats = Rotation.from_matrix(new_from_old.rotation.cpu().numpy()) * Rotation.from_quat(
        splats.quats.cpu().double().roll(-1, 1).numpy()
    )
    sh = harmonics_rotation(rotation, splats.degree) @ torch.cat((splats.sh_dc[:, None], splats.sh_rest), dim=1)
    moved = {
        "means": new_from_old(splats.means.to(new_from_old.rotation)).to(splats.means),
        "quats": torch.from_numpy(quats.as_quat()).roll(1, 1).to(splats.quats),
        "log_scales": splats.log_scales + torch.tensor(new_from_old.scale).log(),
        "sh_dc": sh[:, 0],
        "sh_rest": sh[:, 1:],
    }
    new = deepcopy(splats)
    new.scene_scale *= new_from_old.scale
    new.load(splats.rows() | moved)
    return new


def harmonics_rotation(rotation: Tensor, degree: int) -> Tensor:
    """Return the matrix [K, K] that rotates coefficients of spherical harmonics by a rotation [3, 3]."""
    directions = torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    old = harmonics.basis(directions @ rotation.double().cpu(), degree)  # R^T d, in the old world
    return torch.linalg.lstsq(harmonics.basis(directions, degree), old).solution.to(rotation)
