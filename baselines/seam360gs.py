"""Seam360GS (arXiv 2508.20080): Gaussians trained through the two fisheye lenses that made the panorama.

A preset of `train.lens`. Implemented after the abstract, without the paper and without code, which is not public.
docs/methods.md lists what is stated there and what is inferred.
"""

from padgs.methods.splats.method import SplatMethod
from padgs.render import RenderConfig
from padgs.training.options import TrainOptions


class Seam360GSMethod(SplatMethod):
    """See `padgs.training.method.Method`. `render` is the ideal camera, without a seam."""

    RENDER = RenderConfig(projection="ray")
    TRAIN = TrainOptions(weight="uniform", lens="fisheyes_z")
