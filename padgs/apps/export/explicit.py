"""Explicit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

import padgs
from padgs.apps.export.bake import baked, cameras_around, teach
from padgs.baselines.sc_omnigs import SCOmniGSMethod, aligned
from padgs.data.camera_paths import gravity
from padgs.data.capture import Cloud, DataError
from padgs.evaluation.evaluate import evaluate
from padgs.evaluation.protocols import PROTOCOLS
from padgs.geometry import harmonics
from padgs.methods.anchors.trainee import AnchorTrainee
from padgs.methods.calibration.align import Similarity
from padgs.methods.splats.model import Splats
from padgs.methods.splats.nearest import cameras_of, smoothed
from padgs.methods.splats.trainee import SplatTrainee
from padgs.render import Rendering, render
from padgs.runs.opened import OpenedRun
from padgs.scene import View

LESSONS = 300
OPAQUE = 0.5  # opacity from which on a Gaussian is a point of something
AXES = "axes and units of the scene; its cameras look along z, x is right, y down"


@dataclass(frozen=True)
class Exported:
    """What is written, and what is to be said of it."""

    splats: Splats
    notes: tuple[str, ...]  # a line each
    # [2, 3] where a viewer may begin, and what it looks at: those of the camera in the middle of all; None where that
    # is not known
    begin: Tensor | None


def exported(
    run: OpenedRun,
    *,
    lessons: int = LESSONS,
    stand_up: bool = False,
    smooth: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> Exported:
    """The explicit Gaussians of a run, in the world of its scene.

    Args:
        run: any but EgoNeRF's.
        lessons: iterations that baked anchors learn from their own pictures.
        stand_up: turn the world so that the cameras' up is -y, as viewers expect it.
        smooth: make Gaussians as wide as the finest training view drew them, where a filter in 3D did
            (`padgs.methods.splats.nearest`): viewers, which have no such filter, show those of sharp models as needles.
        progress: called with the number of lessons that are over.

    Raises:
        ValueError: the run has no Gaussians.
        DataError: its data set is not where it was, and all but trained Gaussians, as they are, takes it.
    """
    trainee = run.method.trainee
    config = run.config.render
    notes = [f"padgs {padgs.__version__}, run {run.folder.name}"]
    if isinstance(trainee, SplatTrainee):
        splats = trainee.baked()
        if isinstance(run.method, SCOmniGSMethod):  # it trained in the world of its refined poses
            splats = moved(splats, aligned(run.method.trainee.calibration.poses)[0].inverse())
        notes.append("Gaussians as trained")
        if smooth and config.low_pass > 0 and config.resolved_low_pass_kind == "solid":
            splats = smoothed(splats, cameras_of(run.scene.train), config.low_pass)
            notes[-1] = "Gaussians as trained, each as wide as the finest training view drew it"
    elif isinstance(trainee, AnchorTrainee):
        splats, loss = _baked(run, lessons, progress)
        notes.append(loss)
    else:
        raise ValueError(
            f"{run.config.method} has no Gaussians to export; padgs render and padgs view show what it has learned"
        )
    kind = f"{config.low_pass:g} in {config.resolved_low_pass_kind}"
    notes.append(f"trained with projection {config.projection} and a low-pass of {kind}; viewers have others")
    notes.append(AXES)
    try:
        scene = run.scene
    except DataError:
        if stand_up:
            raise
        notes.append("the data set is not where it was, so that it is not known whether this world has its origin")
        return Exported(splats, tuple(notes), None)
    if scene.origin.any():
        place = " ".join(f"{number:.10g}" for number in scene.origin.tolist())
        notes.append(f"the origin of this world is at {place} in that of the data set, too far for float32")
    begin = _middle(scene.train, scene.scale)
    if stand_up:
        up = torch.tensor(gravity(torch.stack([view.cam_from_world for view in scene.train])).up)
        turn = upright(up)
        splats, begin = moved(splats, turn), turn(begin)
        notes[notes.index(AXES)] = "units of the scene, turned so that -y is up"
    return Exported(splats, tuple(notes), begin)


def _middle(views: Sequence[View], unit: float) -> Tensor:
    """Centre [3] of the view nearest to the middle of all, and a point before it, one `unit` away; on the CPU."""
    centres = torch.stack([view.center.double().cpu() for view in views])
    number = int((centres - centres.mean(0)).norm(dim=-1).argmin())
    ahead = views[number].cam_from_world[2, :3].double().cpu()
    return torch.stack((centres[number], centres[number] + unit * ahead))


def _baked(run: OpenedRun, lessons: int, progress: Callable[[int], None]) -> tuple[Splats, str]:
    scene, config, method = run.scene, run.config.render, run.method
    options = config.options(scene.scale)
    views = cameras_around(scene.train)
    splats = baked(method.trainee.model, views, options, config.backend, scene.scale)
    if lessons:
        teach(splats, method.render, replace(scene, train=tuple(views)), config, lessons, progress)

    def show(view: View) -> Rendering:
        return render(splats.gaussians(view), view, options, backend=config.backend)

    held_out = "test" if scene.test else "training"
    protocol = replace(PROTOCOLS["sphere"], lpips="none", metrics=("ws_psnr",))
    marks = [
        evaluate(drawn, scene.test or scene.train, protocol).metrics["ws_psnr"] or 0 for drawn in (method.render, show)
    ]
    return splats, (
        f"baked: {len(splats)} of {method.size().counts['gaussians']} Gaussians show; WS-PSNR of the {held_out} views "
        f"{marks[1]:.2f} dB, {marks[0] - marks[1]:.2f} dB less than the run's {marks[0]:.2f}"
    )


@torch.no_grad()
def point_cloud(splats: Splats) -> Cloud:
    """The centres of the Gaussians that are opaque, with the mean of their colours over all directions."""
    opaque = torch.sigmoid(splats.opacity_logits) >= OPAQUE
    colors = (0.5 + harmonics.DC * splats.sh_dc[opaque]).clamp(0, 1)
    return Cloud(splats.means[opaque].double().cpu(), (255 * colors).round().to(torch.uint8).cpu())


DOWN = (0.0, 1.0, 0.0)  # of a viewer's world, as far as the PLY of 3DGS has one: that of most structure from motion


@torch.no_grad()
def moved(splats: Splats, new_from_old: Similarity) -> Splats:
    """The same Gaussians in a new world."""
    from scipy.spatial.transform import Rotation

    rotation = new_from_old.rotation.to(splats.means)
    turn = Rotation.from_matrix(new_from_old.rotation.cpu().numpy()) * Rotation.from_quat(
        splats.quats.cpu().double().roll(-1, 1).numpy()
    )
    sh = harmonics_turn(rotation, splats.degree) @ torch.cat((splats.sh_dc[:, None], splats.sh_rest), dim=1)
    empty = splats.means[:0]
    new = Splats(empty, empty, empty, degree=splats.degree, unit=splats.unit * new_from_old.scale)
    new.load(
        {
            "means": new_from_old(splats.means.to(new_from_old.rotation)).to(splats.means),
            "quats": torch.from_numpy(turn.as_quat()).roll(1, 1).to(splats.quats),
            "log_scales": splats.log_scales + torch.tensor(new_from_old.scale).log(),
            "opacity_logits": splats.opacity_logits,
            "sh_dc": sh[:, 0],
            "sh_rest": sh[:, 1:],
        }
    )
    new.active_degree = splats.active_degree
    return new


def harmonics_turn(rotation: Tensor, degree: int) -> Tensor:
    """The matrix [K, K] that maps coefficients of harmonics to those of the turned function, for a rotation [3, 3].

    Turned functions are combinations of the same harmonics, so that as many directions as there are coefficients, in
    general position, say which.
    """
    directions = torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    old = harmonics.basis(directions @ rotation.double().cpu(), degree)  # directions in the old world, R^T d
    return torch.linalg.lstsq(harmonics.basis(directions, degree), old).solution.to(rotation)


def upright(up: Tensor) -> Similarity:
    """The smallest turn after which `up` [3] points against `DOWN`."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.align_vectors([-torch.tensor(DOWN).numpy()], [up.cpu().numpy()])[0]
    return Similarity(1.0, torch.from_numpy(turn.as_matrix()), torch.zeros(3, dtype=torch.float64))
