"""Panoramas of a camera with two fisheye lenses, stitched as if both stood in one place and bent no rays.

What the lens of a pixel sees is drawn exactly; only the stitching ignores the gap between the lenses and their radial
map, so the picture has parallax and a kink at the plane between them. The front lens looks along the camera's z.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from padgs.data.synthetic import camera
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.textures import Array
from padgs.data.synthetic.world import World
from padgs.geometry.lens import axis_direction, bend, hemisphere_weight
from padgs.geometry.panorama import rays


def draw_stitched(world: World, cam_from_world: Array, gap: float, options: SyntheticOptions, gain: float) -> Array:
    """The panorama [H, W, 3] uint8 of a camera whose lenses are `gap` metres apart, its centre midway between them."""
    axis, coefficients = axis_direction("z"), torch.tensor([options.lens_k1], dtype=torch.float64)
    images = []
    for sign in (1.0, -1.0):
        pose = cam_from_world.copy()
        pose[:3, 3] -= sign * 0.5 * gap * axis.numpy()

        def bent(directions: Array, axis: torch.Tensor = sign * axis) -> Array:
            there = bend(torch.from_numpy(directions).double().T, axis, coefficients)
            return there.T.to(torch.float32).numpy()

        images.append(camera.draw(world, pose, options.width, options.samples, options.seed, gain, bent))
    directions = rays(options.width, options.height, dtype=torch.float64)
    weight = hemisphere_weight(directions, axis, math.radians(options.lens_blend)).numpy()[..., None]
    return np.round(weight * images[0] + (1 - weight) * images[1]).astype(np.uint8)
