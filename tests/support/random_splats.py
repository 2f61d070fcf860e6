"""Gaussians with all of their numbers at random."""

import torch

from padgs.methods.splats.splats import Splats
from support.tiny_scene import tiny_scene


def random_splats(degree: int, generator: torch.Generator) -> Splats:
    splats = Splats.from_scene(tiny_scene(), degree=degree, generator=generator)
    for row in splats.rows().values():
        row.data = torch.randn(row.shape, generator=generator)
    splats.active_degree = degree
    return splats
