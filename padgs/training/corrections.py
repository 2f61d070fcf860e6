"""Corrections that training learns for its views: poses, exposures, and the camera that all views share.

Held-out views have no correction of pose and exposure. A pose correction is a quaternion and a translation in the
camera's own frame, so it turns the camera about its own center: x' = R(q) (R x + t) + scale * s. Exposures are gains
and offsets per channel (as in URF, Rematas et al. 2022, but diagonal); their means over panoramas are 1 and 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from padgs.data.camera_paths import centers
from padgs.gaussians import rotation_matrices
from padgs.geometry.camera import Panorama
from padgs.geometry.similarity import Similarity
from padgs.scene import Scene, View
from padgs.training.lenses import ROUGHNESS_WEIGHT, CameraMap, DualLens
from padgs.training.model import Model, TrainingRender
from padgs.training.options import FISHEYES, GIVEN, LEARNED, LEARNED_FAST, MAP, TrainOptions
from padgs.training.schedule import Constant, LogLinear, ParameterGroup
from padgs.training.targets import Target

# Learning rates of poses at the first and the last iteration: of unit quaternions, and of translations in scene scales.
POSE_RATES = {
    LEARNED: ((1e-3, 1e-5), (2e-3, 2e-5)),  # do no harm to exact poses
    LEARNED_FAST: ((1e-2, 1.6e-4), (1e-2, 6e-3)),  # as published (SC-OmniGS)
}
RATE = 3e-3  # of log-gains of exposures; it does not decay, because exposures that freeze early are wrong
OFFSET_RATE = RATE / 5  # of their offsets, in colours from 0 to 1


@dataclass(frozen=True)
class Difference:
    """Residuals of the alignment per camera."""

    distance: Tensor  # [F] between centres, units of the first world
    degrees: Tensor  # [F] between orientations


def align(first: Tensor, second: Tensor) -> tuple[Similarity, Difference]:
    """Return the similarity first_from_second and its residuals for poses cam_from_world [F, 4, 4] float64.

    The rotation is from orientations (centres may lie on a line); scale and translation are least squares.
    """
    rotations = first[:, :3, :3].mT @ second[:, :3, :3]  # first_from_second as each camera sees it
    u, _, vh = torch.linalg.svd(rotations.sum(0))
    flip = torch.ones_like(u[0])
    flip[2] = torch.linalg.det(u @ vh)
    rotation = u * flip @ vh
    a, b = centers(first), centers(second)
    spread = (b - b.mean(0)) @ rotation.mT
    length = spread.square().sum()  # 0 if all cameras stand in one place, which has no scale
    scale = (((a - a.mean(0)) * spread).sum() / length).item() if length > 0 else 1.0
    similarity = Similarity(scale, rotation, a.mean(0) - scale * rotation @ b.mean(0))
    chord = (rotations - rotation).flatten(1).norm(dim=1) / (2 * 2**0.5)  # exact for small angles too
    degrees = torch.rad2deg(2 * torch.asin(chord.clamp(max=1)))
    return similarity, Difference((similarity(b) - a).norm(dim=1), degrees)


class PoseRefinement(nn.Module):
    """Corrections of the poses of named views.

    Each view has its own parameters, so that Adam leaves a view's moments alone while other views are rendered:
    `quaternions`, V times [4] (w, x, y, z), not normalised, and `shifts`, V times [3], camera frame, scene scales.
    `given` [V, 4, 4] float64 are cam_from_world of the V `names` before, `scale` [] is the scene scale in world units.
    """

    given: Tensor
    scale: Tensor

    def __init__(self, names: Sequence[str], given: Tensor, *, scale: float = 1.0) -> None:
        """Begin without corrections; `given` is [V, 4, 4] cam_from_world. Two views of one name are a ValueError."""
        super().__init__()
        if twice := sorted({name for name in names if list(names).count(name) > 1}):
            raise ValueError(f"several training views are called {twice[0]!r}; poses are kept by name, rename them")
        self.names = list(names)
        self.register_buffer("given", given.double())
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float64))
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.quaternions = nn.ParameterList([identity.clone() for _ in names])
        self.shifts = nn.ParameterList([torch.zeros(3) for _ in names])

    @classmethod
    def of(cls, views: Sequence[View], *, scale: float) -> PoseRefinement:
        """Return the refinement of these views."""
        return cls([view.name for view in views], torch.stack([view.cam_from_world for view in views]), scale=scale)

    @classmethod
    def restored(cls, tensors: Mapping[str, Tensor]) -> PoseRefinement:
        """Return the refinement of a `state_dict`, which has no names of views."""
        names = [str(number) for number in range(len(tensors["given"]))]
        poses = cls(names, tensors["given"]).to(tensors["given"].device)
        poses.load_state_dict(tensors)
        return poses

    @torch.no_grad()
    def world(self) -> Similarity:
        """Return the similarity refined_from_given of all cameras."""
        return align(self.poses(), self.given)[0]

    def groups(self, choice: str, iterations: int) -> list[ParameterGroup]:
        """Return the parameters with their `POSE_RATES` in a run of `iterations`."""
        turning, moving = (LogLinear(*ends, iterations) for ends in POSE_RATES[choice])
        return [
            ParameterGroup("pose_quaternions", tuple(self.quaternions), turning, paced=False),
            ParameterGroup("pose_shifts", tuple(self.shifts), moving, paced=False),
        ]

    def refined(self, view: View) -> View:
        """Return one of the named views at its corrected pose; differentiable."""
        index = self.names.index(view.name)
        shift = self.scale * self.shifts[index].double()
        pose = _corrected(self.given[index], self.quaternions[index].double(), shift)
        return replace(view, cam_from_world=pose)

    @torch.no_grad()
    def center(self) -> None:
        """Remove what corrections share, a similarity to first order; this keeps held-out views at their places."""
        rotations = self.given[:, :3, :3]
        beside = -(rotations.mT @ self.given[:, :3, 3:])[..., 0]
        beside = beside - beside.mean(0)  # camera centers, from their mean
        quaternions, shifts = (torch.stack(list(own)).double() for own in (self.quaternions, self.shifts))
        real, imaginary = quaternions.split((1, 3), dim=-1)
        turn = -2 * _each(rotations.mT, imaginary / real).mean(0)  # rotation of the world, radians
        moves = -self.scale * _each(rotations.mT, shifts) - torch.linalg.cross(turn.expand_as(beside), beside)
        moves = moves - moves.mean(0)
        growth = (moves * beside).sum() / beside.square().sum().clamp(min=torch.finfo(beside.dtype).tiny)
        imaginary = imaginary + 0.5 * real * _each(rotations, turn)
        shifts = -_each(rotations, moves - growth * beside) / self.scale
        changed = (*torch.cat((real, imaginary), -1), *shifts)
        for mine, new in zip((*self.quaternions, *self.shifts), changed, strict=True):
            mine.copy_(new)

    @torch.no_grad()
    def poses(self) -> Tensor:
        """Return all corrected poses, cam_from_world [V, 4, 4] float64."""
        quaternions, shifts = (torch.stack(list(own)).double() for own in (self.quaternions, self.shifts))
        return _corrected(self.given, quaternions, self.scale * shifts)

    @torch.no_grad()
    def summary(self) -> str:
        """Return the median correction as a sentence, without a similarity of the whole world."""
        left = align(self.poses(), self.given)[1]
        distance, degrees = left.distance.median(), left.degrees.median()
        return f"poses moved by {distance:.3g} world units and {degrees:.3g} degrees (median)"


def _corrected(given: Tensor, quaternions: Tensor, shifts: Tensor) -> Tensor:
    """Return poses [..., 4, 4] turned by quaternions [..., 4] and shifted by shifts [..., 3], world units."""
    upper = rotation_matrices(quaternions) @ given[..., :3, :]
    upper = torch.cat((upper[..., :3], upper[..., 3:] + shifts[..., None]), dim=-1)
    return torch.cat((upper, given[..., 3:, :]), dim=-2)


def _each(rotations: Tensor, vectors: Tensor) -> Tensor:
    """Return rotations [V, 3, 3] times vectors [V, 3] or [3]."""
    return (rotations @ vectors[..., None])[..., 0]


class Corrections(nn.Module):
    """Corrections of the training views of a scene; no parameters if nothing is corrected.

    `poses` and `lens`, the camera of all views, are None if they are not learned; `log_gains` and `offsets` are V times
    [3] for each colour channel, a parameter per view as for poses, and empty if exposures are not learned.
    """

    def __init__(self, scene: Scene, options: TrainOptions) -> None:
        """Begin without corrections; a ValueError if poses or a lens cannot be learned on this scene."""
        super().__init__()
        self._options = options
        views = len(scene.train) if options.exposures == LEARNED else 0
        self._panoramas = len(scene.panoramas)  # which come first
        self.log_gains, self.offsets = (nn.ParameterList([torch.zeros(3) for _ in range(views)]) for _ in range(2))
        self.poses = None if options.poses == GIVEN else PoseRefinement.of(scene.train, scale=scene.scale)
        self.lens: CameraMap | DualLens | None = None
        if options.lens != GIVEN:
            for view in scene.train:
                if not isinstance(view.camera, Panorama):
                    raise ValueError(f"train.lens is {options.lens}, but view {view.name!r} is no panorama; set given")
            first, axis = scene.train[0], options.lens.removeprefix(FISHEYES)
            is_map = options.lens == MAP
            if is_map and options.depth_weight:
                raise ValueError("train.lens=map resamples photographs, and not their depth maps; set depth_weight=0")
            self.lens = CameraMap(first.width, first.height) if is_map else DualLens(axis, scene_scale=scene.scale)

    def groups(self, iterations: int) -> list[ParameterGroup]:
        """Return all parameters with their learning rates in a run of `iterations`; exposures follow its pace."""
        exposures = [
            ParameterGroup("exposure_log_gains", tuple(self.log_gains), Constant(RATE)),
            ParameterGroup("exposure_offsets", tuple(self.offsets), Constant(OFFSET_RATE)),
        ]
        groups = exposures if self.log_gains else []
        groups += [] if self.poses is None else self.poses.groups(self._options.poses, iterations)
        return groups + ([] if self.lens is None else self.lens.groups(iterations))

    def draw(self, model: Model, view: View) -> TrainingRender:
        """Render a training view at its corrected pose and through its lenses."""
        view = view if self.poses is None else self.poses.refined(view)
        if isinstance(self.lens, DualLens):
            return self.lens.draw(model.draw, view)
        drawing = model.draw(view)
        if self.lens is None:
            return drawing
        rough = ROUGHNESS_WEIGHT * self.lens.roughness()
        return replace(drawing, penalty=rough if drawing.penalty is None else drawing.penalty + rough)

    def undistorted(self, view: View, target: Target) -> Target:
        """Return the target of a training view as an ideal camera would take it; differentiable."""
        return self.lens.undistorted(view, target, self._options.weight) if isinstance(self.lens, CameraMap) else target

    def exposed(self, image: Tensor, index: int) -> Tensor:
        """Return the render [H, W, 3] of training view `index` under its exposure; differentiable."""
        return image * self.log_gains[index].exp() + self.offsets[index] if self.log_gains else image

    @torch.no_grad()
    def center(self) -> None:
        """Center exposures over the panoramas, and poses over all views; called after each optimizer step."""
        for of_views in (self.log_gains, self.offsets):
            mean = torch.stack(list(of_views)[: self._panoramas]).mean(0) if of_views else 0
            for own in of_views:
                own -= mean
        if self.poses is not None and self._options.poses == LEARNED:
            self.poses.center()

    def summary(self) -> tuple[str, ...]:
        """Return the results as sentences."""
        return tuple(part.summary() for part in (self.poses, self.lens) if part is not None)
