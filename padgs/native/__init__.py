"""Compiled code and its calls: rendering, decoding, loss, and the peak rates of a machine."""

from types import ModuleType

import torch
from torch import Tensor

from padgs.native import cpu, cuda
from padgs.native.loading import succeeds

LIBRARIES = {"cpu": cpu, "cuda": cuda}  # by torch device type


def library_for(tensor: Tensor) -> ModuleType | None:
    """Return the module of the library that takes a float32 tensor on its device; None if torch must do it."""
    library = LIBRARIES.get(tensor.device.type)
    if library is None or tensor.dtype != torch.float32:
        return None
    return library if succeeds(lambda: library.require(tensor.device)) else None
