"""Splats as a view sees them, and the derivatives by what is learned, in one kernel each (csrc/cuda/splats.cu).

`padgs.methods.splats.model.Splats` has the definition.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from padgs.methods.splats import cpu_splats
from padgs.native import LIBRARIES, cuda
from padgs.native.abi import SplatArguments, pointer


def fits(means: Tensor, center: Tensor) -> bool:
    """Whether there are kernels for these: float32 on a GPU that the library works on, a camera that does not learn."""
    if LIBRARIES.get(means.device.type) is not cuda or means.dtype != torch.float32 or center.requires_grad:
        return False
    return cuda.works_on(means.device)


def native_splats(learned: cpu_splats.Learned, degree: int, center: Tensor, tiny: float) -> cpu_splats.Seen:
    """`padgs.methods.splats.cpu_splats.native_splats` where the GPU's library keeps its tensors; `center` is there, too."""
    return cpu_splats.native_splats(learned, degree, center.contiguous(), tiny, run=_run)


def _run(sizes: tuple, center: Tensor, tiny: float, *tensors: Tensor | None) -> None:
    splats = SplatArguments(*sizes, (ctypes.c_float * 3)(), tiny, *map(pointer, tensors))
    cuda.call("padgs_cuda_splats", cuda.queue(center.device), cuda.DeviceSplatArguments(splats, pointer(center)))
