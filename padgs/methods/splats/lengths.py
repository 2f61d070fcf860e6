"""The length that the steps and sizes of each Gaussian are multiples of.

3DGS takes the extent of all cameras. In one room that is about the distance to the walls, in eight rooms in a row 12
times the distance to the nearest camera: in short runs means then move by pixels at a time, and Gaussians as large as
furniture are cloned rather than split. The distance to the nearest camera does not grow with the number of rooms.
"""

import torch
from torch import Tensor

from padgs.methods.splats.smoothing_filter import finest_pixels

EXTENT, NEAREST_CAMERA = "extent", "nearest_camera"
LENGTH_UNITS = (EXTENT, NEAREST_CAMERA)
EXTENT_PER_DISTANCE = 1.5  # extent over median distance of points to the nearest camera in `bedroom`


class LocalLengths:
    """`EXTENT_PER_DISTANCE` times the distance of each Gaussian to the nearest training camera.

    `values` [N, 1], world units, have no derivative and follow the means whenever they are updated.
    """

    def __init__(self, cameras: Tensor) -> None:
        """Take the training cameras [V, 4] from `cameras_of`."""
        self._cameras = torch.cat((cameras[:, :3], torch.ones_like(cameras[:, 3:])), dim=1)  # a pixel is the distance
        self.values = torch.zeros(0, 1)

    def at(self, means: Tensor) -> Tensor:
        """Return the lengths [N] at means [N, 3]."""
        return EXTENT_PER_DISTANCE * finest_pixels(means.detach(), self._cameras)

    def update(self, means: Tensor) -> None:
        """Measure the lengths at the means [N, 3] of all Gaussians."""
        self._cameras = self._cameras.to(means.device)  # copied once, or a GPU would wait each time
        self.values = self.at(means)[:, None]
