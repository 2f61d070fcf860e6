"""Exact ground truth of a synthetic scene: poses without noise, and radial depth of any view."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from padgs.data.capture import DataError
from padgs.data.synthetic import camera, paths, scenes
from padgs.data.synthetic.furniture import person
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.textures import Array
from padgs.data.synthetic.world import World
from padgs.scene import View

_STREAMS = ("path", "poses", "furniture", "points", "pose noise", "figure")
_FIGURE_DISTANCES = (0.8, 2.0)  # metres from the camera, where a camera was or will be


class SyntheticTruth:
    """World of a synthetic scene. Lengths in and out are world units."""

    def __init__(self, options: SyntheticOptions) -> None:
        description = scenes.descriptions()["scenes"][options.scene]
        if options.objects is None:
            options = replace(options, objects=description["objects"])
        self.options = options
        radius, walk = options.path_radius, scenes.walk(options)
        if radius is not None:
            walk = replace(walk, half=(radius, radius), waypoints=())
        path = paths.curve(walk, options.path or description["path"], self.random("path"))
        self.poses = paths.poses(options, path, self.random("poses"))  # [n, 4, 4] metres, exact
        self.world: World = scenes.world(options, path, self.random("furniture"))

    def random(self, stream: str) -> np.random.Generator:
        """Return the generator of one purpose, so that options do not change unrelated random numbers."""
        return np.random.default_rng((self.options.seed, _STREAMS.index(stream)))

    def world_seen(self, index: int) -> World:
        """Return the world as a view shows it: a training view with the walking figure, if there is one."""
        if not self.options.figure or index in paths.held_out(self.options):
            return self.world
        rng = np.random.default_rng((self.options.seed, _STREAMS.index("figure"), index))
        places = np.array([camera.center(pose)[:2] for pose in self.poses])
        distance = np.linalg.norm(places - places[index], axis=1)
        near, far = _FIGURE_DISTANCES
        free = np.flatnonzero((distance > near) & (distance < far))
        x, y = places[rng.choice(free) if len(free) else np.argmax(distance)].tolist()
        return self.world.joined_by(person(x, y, rng.uniform(-np.pi, np.pi)))

    @property
    def names(self) -> list[str]:
        """Return the names of all views in order along the path."""
        return [f"{index:03d}" for index in range(len(self.poses))]

    def exact_pose(self, name: str) -> Tensor:
        """Return the exact cam_from_world [4, 4] float64 of a view, in world units."""
        if name not in self.names:
            raise DataError(f"unknown view {name!r}; known: {self.names[0]} to {self.names[-1]}")
        pose = self.poses[self.names.index(name)].copy()
        pose[:3, 3] *= self.options.world_scale
        return torch.from_numpy(pose)

    def depth(self, view: View) -> Tensor:
        """Return distances [H, W] float64 to the surface at pixel centres, in world units; inf = sky."""
        distance, _ = camera.trace(self.world, self._pose(view), view.width)
        return torch.from_numpy(distance * self.options.world_scale)

    @cached_property
    def median_depth(self) -> float:
        """Return the median over views of the median finite distance, in metres."""
        medians = []
        for pose in self.poses[:: max(1, len(self.poses) // 8)]:
            distance, _ = camera.trace(self.world, pose, 64)
            medians.append(np.median(distance[np.isfinite(distance)]))
        return float(np.median(medians))

    @cached_property
    def given_poses(self) -> Array:
        """Return the poses [n, 4, 4] of the scene in world units, with pose noise on training views."""
        from scipy.spatial.transform import Rotation

        rng = self.random("pose noise")
        shift = self.options.pose_noise_translation * self.median_depth if self.options.pose_noise_translation else 0.0
        angle = np.radians(self.options.pose_noise_rotation)
        given = self.poses.copy()
        held_out = set(paths.held_out(self.options))
        for index in range(len(given)):
            offset, axis, size = rng.standard_normal(3), rng.standard_normal(3), rng.standard_normal()
            if index not in held_out:
                turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle * size).as_matrix()
                rotation = turn @ given[index, :3, :3]
                position = camera.center(given[index]) + shift * offset
                given[index, :3, :3], given[index, :3, 3] = rotation, -rotation @ position
        given[:, :3, 3] *= self.options.world_scale
        return given

    def _pose(self, view: View) -> Array:
        """Return a view's pose in metres, without noise if it is a view of the scene."""
        pose = view.cam_from_world.detach().cpu().double().numpy().copy()
        if view.name in self.names:
            index = self.names.index(view.name)
            if np.array_equal(pose, self.given_poses[index]):
                return self.poses[index]
        pose[:3, 3] /= self.options.world_scale
        return pose
