"""SC-OmniGS (arXiv 2502.04734): OmniGS with self-calibration of poses and of the panoramic camera.

A preset of `train.poses` and `train.lens`, and a penalty. Implemented after the abstract and the project page, without
the paper and without code, which is not public. docs/methods.md lists what is stated there and what is inferred.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.baselines.omnigs import OmniGSMethod
from padgs.checks import check
from padgs.methods.splats.method import SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.scene import View
from padgs.training.model import TrainingRender
from padgs.training.options import TrainOptions


@dataclass(frozen=True)
class SCOmniGSOptions(SplatOptions):
    """Options of OmniGS and of the penalty on thin Gaussians."""

    anisotropy_weight: float = 1e-3  # loss weight of `anisotropy`
    anisotropy_ratio: float = 10.0  # longest to shortest axis without penalty

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "at least 0, which switches it off", lambda weight: weight >= 0, "anisotropy_weight")
        check(self, "longest to shortest, at least 1", lambda ratio: ratio >= 1, "anisotropy_ratio")


class SCOmniGSModel(SplatModel):
    """Splats with a penalty on thin ones."""

    options: SCOmniGSOptions

    def draw(self, view: View, mean_offsets: Tensor | None = None) -> TrainingRender:
        drawing, options = super().draw(view, mean_offsets), self.options
        penalty = options.anisotropy_weight * anisotropy(drawing.gaussians.scales, options.anisotropy_ratio)
        return replace(drawing, penalty=penalty)


class SCOmniGSMethod(OmniGSMethod):
    """SC-OmniGS (Huang et al. 2025): poses and a map of the camera are learned with the Gaussians."""

    Options = SCOmniGSOptions
    MODEL = SCOmniGSModel
    TRAIN = TrainOptions(weight="solid_angle", poses="learned_fast", lens="map")


def anisotropy(scales: Tensor, ratio: float) -> Tensor:
    """Return the mean excess of ln(longest / shortest axis) over ln(ratio), for scales [N, 3]; a scalar.

    >>> round(anisotropy(torch.tensor([[1.0, 1.0, 20.0], [1.0, 1.0, 1.0]]), 10.0).item(), 4)  # ln(2) / 2
    0.3466
    """
    return torch.relu(torch.log(scales.amax(-1) / scales.amin(-1)) - math.log(ratio)).mean()
