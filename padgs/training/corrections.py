"""Corrections that training learns for its views: poses and exposures. Held-out views and stored models have none.

A pose correction is a quaternion and a translation in the camera's own frame, so it turns the camera about its own
center wherever the world's origin lies: x' = R(q) (R x + t) + scale * s. Exposures are gains and offsets per channel
(as in URF, Rematas et al. 2022, but diagonal). They are relative: log-gains and offsets have a mean of 0 over all
views, so held-out views have the mean exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor, nn

from padgs.gaussians import rotation_matrices
from padgs.scene import Scene, View
from padgs.training.schedule import Constant, LogLinear, ParameterGroup


@dataclass(frozen=True)
class PoseRates:
    """Learning rates of poses, log-linear over the run; defaults as published (SC-OmniGS)."""

    rotation: float = 1e-2  # of unit quaternions, at the first iteration
    rotation_end: float = 1.6e-4  # at the last iteration
    translation: float = 1e-2  # scene scales, at the first iteration
    translation_end: float = 6e-3  # at the last iteration

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"poses.{field.name} is {getattr(self, field.name)}; a learning rate must be > 0")


SMALL = PoseRates(rotation=1e-3, rotation_end=1e-5, translation=2e-3, translation_end=2e-5)  # do no harm to exact poses


class PoseRefinement(nn.Module):
    """Corrections of the poses of named views.

    Each view has its own parameters, so that Adam leaves a view's moments alone while other views are rendered.

    Attributes:
        names: names of the V views.
        given: [V, 4, 4] float64 cam_from_world before the correction.
        quaternions: V times [4] (w, x, y, z), not normalised.
        shifts: V times [3], camera frame, scene scales.
        scale: scene scale in world units.
    """

    given: Tensor

    def __init__(self, names: Sequence[str], given: Tensor, *, scale: float = 1.0) -> None:
        """Begin without corrections; `given` is [V, 4, 4] cam_from_world. Two views of one name are a ValueError."""
        super().__init__()
        twice = sorted({name for name in names if list(names).count(name) > 1})
        if twice:
            raise ValueError(f"several training views are called {twice[0]!r}; poses are kept by name, rename them")
        self.names, self.scale = list(names), scale
        self.register_buffer("given", given.double())
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.quaternions = nn.ParameterList([identity.clone() for _ in names])
        self.shifts = nn.ParameterList([torch.zeros(3) for _ in names])

    @classmethod
    def of(cls, views: Sequence[View], *, scale: float) -> PoseRefinement:
        """Return the refinement of these views."""
        return cls([view.name for view in views], torch.stack([view.cam_from_world for view in views]), scale=scale)

    def groups(self, rates: PoseRates, iterations: int) -> list[ParameterGroup]:
        """Return the parameters with their learning rates in a run of `iterations`."""
        turning = LogLinear(rates.rotation, rates.rotation_end, iterations)
        moving = LogLinear(rates.translation, rates.translation_end, iterations)
        return [
            ParameterGroup("pose_quaternions", tuple(self.quaternions), turning, paced=False),
            ParameterGroup("pose_shifts", tuple(self.shifts), moving, paced=False),
        ]

    def refined(self, view: View) -> View:
        """Return the view at its corrected pose; differentiable. A view without a correction is a ValueError."""
        if view.name not in self.names:
            raise ValueError(f"view {view.name!r} has no pose to refine; known: {', '.join(self.names)}")
        return replace(view, cam_from_world=self._pose(self.names.index(view.name)))

    @torch.no_grad()
    def center(self) -> None:
        """Remove what all corrections have in common: to first order, a similarity of the whole world.

        This keeps held-out views at their given places.
        """
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
        for mine, new in zip(
            [*self.quaternions, *self.shifts], [*torch.cat((real, imaginary), -1), *shifts], strict=True
        ):
            mine.copy_(new)

    @torch.no_grad()
    def poses(self) -> Tensor:
        """Return all corrected poses, cam_from_world [V, 4, 4] float64."""
        return torch.stack([self._pose(index) for index in range(len(self.names))])

    def _pose(self, index: int) -> Tensor:
        turn, given = rotation_matrices(self.quaternions[index].double()), self.given[index]
        upper = turn @ given[:3]
        shift = self.scale * self.shifts[index].double()
        return torch.cat((torch.cat((upper[:, :3], upper[:, 3:] + shift[:, None]), dim=1), given[3:]))


def _each(rotations: Tensor, vectors: Tensor) -> Tensor:
    """Return rotations [V, 3, 3] times vectors [V, 3] or [3]."""
    return (rotations @ vectors[..., None])[..., 0]


RATE = 3e-3  # of log-gains; it does not decay, because exposures that freeze early are wrong
OFFSET_RATE = RATE / 5  # of offsets, in colours from 0 to 1
GIVEN, LEARNED = "given", "learned"
CHOICES = (GIVEN, LEARNED)  # of exposures, and of poses


class Corrections(nn.Module):
    """Corrections of the training views of a scene; no parameters if nothing is corrected.

    Attributes:
        poses: corrections of the poses; None if they are not learned.
        log_gains, offsets: V times [3] for each colour channel, a parameter per view as for poses; empty if exposures
            are not learned.
    """

    def __init__(self, scene: Scene, *, exposures: bool, poses: bool) -> None:
        """Begin without corrections; learned poses of two views of one name are a ValueError."""
        super().__init__()
        views = len(scene.train) if exposures else 0
        self.log_gains, self.offsets = (nn.ParameterList([torch.zeros(3) for _ in range(views)]) for _ in range(2))
        self.poses = PoseRefinement.of(scene.train, scale=scene.scale) if poses else None

    def groups(self, iterations: int) -> list[ParameterGroup]:
        """Return all parameters with their learning rates in a run of `iterations`; exposures follow its pace."""
        exposures = [
            ParameterGroup("exposure_log_gains", tuple(self.log_gains), Constant(RATE)),
            ParameterGroup("exposure_offsets", tuple(self.offsets), Constant(OFFSET_RATE)),
        ]
        poses = self.poses.groups(SMALL, iterations) if self.poses else []
        return (exposures if self.log_gains else []) + poses

    def posed(self, view: View) -> View:
        """Return a training view at its corrected pose; differentiable."""
        return self.poses.refined(view) if self.poses else view

    def exposed(self, image: Tensor, index: int) -> Tensor:
        """Return the render [H, W, 3] of training view `index` under its exposure; differentiable."""
        return image * self.log_gains[index].exp() + self.offsets[index] if self.log_gains else image

    @torch.no_grad()
    def center(self) -> None:
        """Remove what the corrections of all views have in common; called after each optimizer step."""
        for of_views in (self.log_gains, self.offsets):
            mean = torch.stack(list(of_views)).mean(0) if of_views else 0
            for own in of_views:
                own -= mean
        if self.poses:
            self.poses.center()
