"""Poses that learn: a small rigid correction for each training view, optimised with the model.

The correction is a quaternion and a translation in the camera's own frame, so it turns the camera about its own centre,
wherever the origin of the world lies: x' = R(q) (R x + t) + unit * s.
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
    """Learning rates of the poses, log-linear from the first to the last iteration. As published (SC-OmniGS)."""

    rotation: float = 1e-2  # of unit quaternions
    rotation_end: float = 1.6e-4  # ... and of the last iteration
    translation: float = 1e-2  # scene units
    translation_end: float = 6e-3  # ... and of the last iteration

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"poses.{field.name} is {getattr(self, field.name)}; a learning rate must be > 0")


SMALL = PoseRates(rotation=1e-3, rotation_end=1e-5, translation=2e-3, translation_end=2e-5)  # harmless to exact poses


class PoseRefinement(nn.Module):
    """Corrections of the poses of named views.

    Each view has parameters of its own, so that the optimizer's moments of a view rest while other views are drawn.

    Attributes:
        names: of the V views.
        given: [V, 4, 4] float64 cam_from_world before the correction.
        quaternions: V times [4] (w, x, y, z), not normalised.
        shifts: V times [3] camera frame, scene units.
        unit: the scene's unit of length in world units.
    """

    given: Tensor

    def __init__(self, names: Sequence[str], given: Tensor, *, unit: float = 1.0) -> None:
        """No correction yet; `given` is [V, 4, 4] cam_from_world.

        Raises:
            ValueError: two views of one name.
        """
        super().__init__()
        twice = sorted({name for name in names if list(names).count(name) > 1})
        if twice:
            raise ValueError(f"several training views are called {twice[0]!r}; poses are kept by name, rename them")
        self.names, self.unit = list(names), unit
        self.register_buffer("given", given.double())
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.quaternions = nn.ParameterList([identity.clone() for _ in names])
        self.shifts = nn.ParameterList([torch.zeros(3) for _ in names])

    @classmethod
    def of(cls, views: Sequence[View], *, unit: float) -> PoseRefinement:
        """For these views."""
        return cls([view.name for view in views], torch.stack([view.cam_from_world for view in views]), unit=unit)

    def groups(self, rates: PoseRates, iterations: int) -> list[ParameterGroup]:
        """Learning rates for a run of `iterations`."""
        turning = LogLinear(rates.rotation, rates.rotation_end, iterations)
        moving = LogLinear(rates.translation, rates.translation_end, iterations)
        return [
            ParameterGroup("pose_quaternions", tuple(self.quaternions), turning, paced=False),
            ParameterGroup("pose_shifts", tuple(self.shifts), moving, paced=False),
        ]

    def refined(self, view: View) -> View:
        """The view at its corrected pose; differentiable.

        Raises:
            ValueError: no view of this name is being refined.
        """
        if view.name not in self.names:
            raise ValueError(f"view {view.name!r} has no pose to refine; known: {', '.join(self.names)}")
        return replace(view, cam_from_world=self._pose(self.names.index(view.name)))

    @torch.no_grad()
    def centre(self) -> None:
        """Take out what all corrections have in common: to first order, a similarity of the whole world.

        Then the world stays the given one, and held-out views stand in it where they are said to.
        """
        rotations = self.given[:, :3, :3]
        beside = -(rotations.mT @ self.given[:, :3, 3:])[..., 0]
        beside = beside - beside.mean(0)  # the centres, from their middle
        quaternions, shifts = (torch.stack(list(own)).double() for own in (self.quaternions, self.shifts))
        real, imaginary = quaternions.split((1, 3), dim=-1)
        turn = -2 * _each(rotations.mT, imaginary / real).mean(0)  # of the world, radians
        moves = -self.unit * _each(rotations.mT, shifts) - torch.linalg.cross(turn.expand_as(beside), beside)
        moves = moves - moves.mean(0)
        growth = (moves * beside).sum() / beside.square().sum().clamp(min=torch.finfo(beside.dtype).tiny)
        imaginary = imaginary + 0.5 * real * _each(rotations, turn)
        shifts = -_each(rotations, moves - growth * beside) / self.unit
        for mine, new in zip(self.quaternions, torch.cat((real, imaginary), dim=-1), strict=True):
            mine.copy_(new)
        for mine, new in zip(self.shifts, shifts, strict=True):
            mine.copy_(new)

    @torch.no_grad()
    def poses(self) -> Tensor:
        """All corrected poses, cam_from_world [V, 4, 4] float64."""
        return torch.stack([self._pose(index) for index in range(len(self.names))])

    def _pose(self, index: int) -> Tensor:
        turn, given = rotation_matrices(self.quaternions[index].double()), self.given[index]
        upper = turn @ given[:3]
        shift = self.unit * self.shifts[index].double()
        return torch.cat((torch.cat((upper[:, :3], upper[:, 3:] + shift[:, None]), dim=1), given[3:]))


def _each(rotations: Tensor, vectors: Tensor) -> Tensor:
    """Rotations [V, 3, 3] times vectors [V, 3] or [3]."""
    return (rotations @ vectors[..., None])[..., 0]


RATE = 3e-3  # of log-gains; at the end still so much, for what is frozen early is wrong
OFFSET_RATE = RATE / 5  # of offsets, in colours from 0 to 1


class Exposures(nn.Module):
    """Of V views, by their numbers; see `padgs.training.corrections.Corrections`.

    Each view has parameters of its own, so that the optimizer's moments of a view rest while other views are drawn.

    Attributes:
        log_gains, offsets: V times [3], of the colour channels.
    """

    def __init__(self, views: int) -> None:
        """No correction yet."""
        super().__init__()
        self.log_gains, self.offsets = (nn.ParameterList([torch.zeros(3) for _ in range(views)]) for _ in range(2))

    def groups(self) -> list[ParameterGroup]:
        """Learning rates, at the pace of the run as those of the model that they follow."""
        return [
            ParameterGroup("exposure_log_gains", tuple(self.log_gains), Constant(RATE)),
            ParameterGroup("exposure_offsets", tuple(self.offsets), Constant(OFFSET_RATE)),
        ]

    def exposed(self, image: Tensor, index: int) -> Tensor:
        """An image [H, W, 3] as view `index` would show it; differentiable."""
        return image * self.log_gains[index].exp() + self.offsets[index]

    @torch.no_grad()
    def centre(self) -> None:
        """Take the mean out again; called after each step."""
        for of_views in (self.log_gains, self.offsets):
            mean = torch.stack(list(of_views)).mean(0)
            for own in of_views:
                own -= mean


GIVEN, LEARNED = "given", "learned"
CHOICES = (GIVEN, LEARNED)  # of exposures, and of poses


class Corrections(nn.Module):
    """Corrections of the training views of a scene; without parameters where nothing is corrected."""

    def __init__(self, scene: Scene, *, exposures: bool, poses: bool) -> None:
        """No correction yet.

        Raises:
            ValueError: poses shall learn, but two views have one name.
        """
        super().__init__()
        self.exposures = Exposures(len(scene.train)) if exposures else None
        self.poses = PoseRefinement.of(scene.train, unit=scene.scale) if poses else None

    def groups(self, iterations: int) -> list[ParameterGroup]:
        """All parameters, with their learning rates in a run of `iterations`."""
        exposures = [] if self.exposures is None else self.exposures.groups()
        return exposures + ([] if self.poses is None else self.poses.groups(SMALL, iterations))

    def posed(self, view: View) -> View:
        """A training view where it is taken to have been; differentiable."""
        return view if self.poses is None else self.poses.refined(view)

    def exposed(self, image: Tensor, index: int) -> Tensor:
        """What was drawn of training view `index`, [H, W, 3], as its photograph was exposed; differentiable."""
        return image if self.exposures is None else self.exposures.exposed(image, index)

    def centre(self) -> None:
        """Have all corrections together change nothing; called after each step of the optimizer."""
        for part in (self.exposures, self.poses):
            if part is not None:
                part.centre()
