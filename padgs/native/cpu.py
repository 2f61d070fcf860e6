"""libpadgs_cpu: tiles, SIMD, OpenMP (`csrc/cpu`). Importing this module loads nothing."""

import ctypes
import functools

import torch

from padgs.native import abi
from padgs.native.abi import Int32, Int64, Pointer
from padgs.native.loading import Library, declare, find_library, succeeds

STRUCTURES = (
    *(abi.NativeCamera, abi.Inputs, abi.Gradients, abi.BlendGradientArguments, abi.DecodeGradientArguments),
    *(abi.LossArguments, abi.SplatArguments, abi.LeaveOneOutArguments, abi.RoughnessArguments),
)
SIGNATURES = {
    **dict.fromkeys(("padgs_blend_forward", "padgs_blend_backward", "padgs_leave_one_out"), ([Pointer], None)),
    **dict.fromkeys(("padgs_decode_select", "padgs_decode_place", "padgs_decode_backward"), ([Pointer], None)),
    "padgs_splats": ([Pointer], None),
    "padgs_isa": ([], ctypes.c_char_p),
    "padgs_structure_bytes": ([Int32], Int64),
    "padgs_project": ([Pointer] * 4, None),
    "padgs_project_backward": ([Pointer] * 4, None),
    "padgs_tile_levels": ([Pointer] * 2, None),
    "padgs_depth_order": ([Pointer, Pointer, Int64, Pointer], Int64),
    "padgs_count_instances": ([Pointer, Int64, Pointer, Int32, Pointer], None),
    "padgs_bin": ([Pointer, Int64, Pointer, Int64, *[Pointer] * 4], None),
    "padgs_sum_moments": ([Pointer, Pointer, Int64, Pointer], None),
    "padgs_core_words": ([Pointer], Int64),
    "padgs_photometric_loss": ([Pointer], ctypes.c_double),
    "padgs_loss_workspace": ([Int32, Int32], Int64),
    "padgs_roughness": ([Pointer], ctypes.c_double),
    "padgs_roughness_workspace": ([Int32, Int32], Int64),
    "padgs_measure_fma": ([Int64], ctypes.c_double),
    "padgs_measure_triad": ([Pointer, Pointer, Int64], ctypes.c_double),
}


@functools.cache
def library() -> Library:
    """Return the loaded CPU library; OSError if it is missing, does not load, or is of other sources."""
    return declare(find_library("padgs_cpu", "a C++ compiler"), SIGNATURES, "padgs_structure_bytes", STRUCTURES)


@functools.cache
def available() -> bool:
    """Return whether the native CPU library is built and loads."""
    return succeeds(library)


@functools.lru_cache(maxsize=4)
def workspace(size_of: str, height: int, width: int) -> torch.Tensor:
    """Return scratch memory for images, of a size that a function of the library states.

    Kept between iterations, because page faults of fresh memory cost more than a loss. Python threads share it, so only
    one may train at a time.
    """
    return torch.zeros(getattr(library(), size_of)(height, width), dtype=torch.float32)


def require(_: torch.device) -> None:
    """Raise OSError, as `library` does, if the library is not available."""
    library()
