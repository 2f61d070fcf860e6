"""Points drawn onto the panorama that should show them: one look tells whether poses and points fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from padgs.data.errors import DataError
from padgs.geometry.panorama import project
from padgs.scene import View

OVERLAY = "check.png"  # beside the data, where no other place is given
WIDTH = 2048  # of the picture at most


def draw_overlay(view: View, points: Tensor, path: Path, most: int = 20_000) -> None:
    """Save a panorama with points on it, red = near, blue = far (by rank), as PNG.

    Args:
        view: pose and pixels.
        points: [P, 3] world.
        path: where to.
        most: points drawn; more of them are thinned out evenly.

    Raises:
        DataError: the file cannot be written.
    """
    assert view.load_pixels is not None
    image = Image.fromarray(view.load_pixels().cpu().numpy())
    if image.width > WIDTH:
        image = image.resize((WIDTH, WIDTH // 2), Image.Resampling.BOX)
    pixels = np.asarray(image).astype(np.float32) * 0.6
    height, width = pixels.shape[:2]
    points = points[:: -(-len(points) // most)].double()
    seen = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    column, row = project(seen, width, height).long().unbind(1)
    rank = seen.norm(dim=1).argsort(descending=True)  # far ones first, so that near ones lie on top
    nearness = torch.linspace(0, 1, len(rank)).numpy()[:, None]
    color = 255 * (nearness * np.array([1.0, 0.25, 0.0]) + (1 - nearness) * np.array([0.0, 0.5, 1.0]))
    radius = max(0, width // 1024)
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            r, c = (row[rank] + down).clamp(0, height - 1).numpy(), ((column[rank] + right) % width).numpy()
            pixels[r, c] = color
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(path)
    except OSError as error:
        raise DataError(f"cannot write the picture {path} ({error.strerror or error}); give another place") from error
