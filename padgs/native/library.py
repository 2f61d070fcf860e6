"""Finds and loads the native library; importing this module loads nothing.

The library is plain C: pointers and sizes in, nothing out but numbers. The structures here mirror `csrc/abi.h`.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch  # noqa: F401 - first: the library then shares torch's OpenMP threads and thread count
from torch import Tensor

Pointer = ctypes.c_void_p
Int32, Int64 = ctypes.c_int32, ctypes.c_int64


def fields(kind: type, *names: str) -> list[tuple[str, type]]:
    """Members of a structure that are of one type."""
    return [(name, kind) for name in names]


class Camera(ctypes.Structure):
    """`padgs::Camera`."""

    _fields_ = [
        *fields(ctypes.c_int32, "width", "height", "projection", "model"),
        ("cam_from_world", ctypes.c_float * 12),
        *fields(ctypes.c_float, "near_radius", "low_pass"),
        *fields(ctypes.c_int32, "wrap", "square"),
        *fields(ctypes.c_float, "fx", "fy", "cx", "cy", "widen", "off_panorama"),
        *fields(ctypes.c_int32, "compensate", "cull_ellipsoids"),
    ]


class TileGrid(ctypes.Structure):
    """`padgs::TileGrid`."""

    _fields_ = [
        *fields(ctypes.c_int32, "width", "height", "first_row", "end_row"),
        *fields(Pointer, "level", "row_start"),
    ]


class Inputs(ctypes.Structure):
    """`padgs::Inputs`."""

    _fields_ = [
        ("count", ctypes.c_int64),
        *fields(Pointer, "means", "quats", "scales", "opacities", "colors", "probe"),
    ]


class Gradients(ctypes.Structure):
    """`padgs::Gradients`."""

    _fields_ = fields(Pointer, "means", "quats", "scales", "opacities", "colors", "probe", "pose")


class Rays(ctypes.Structure):
    """`padgs::Rays`."""

    _fields_ = fields(Pointer, "column_sine", "column_cosine", "row_sine", "row_cosine", "table")


class BlendArguments(ctypes.Structure):
    """`padgs::BlendArguments`."""

    _fields_ = [
        ("grid", TileGrid),
        *fields(ctypes.c_int32, "projection", "wrap", "core_size"),
        ("rays", Rays),
        *fields(Pointer, "footprints", "tile_start", "instances", "background"),
        *fields(Pointer, "image", "transmittance", "depth", "last", "pair_counts", "cores", "core_start"),
    ]


class BlendGradientArguments(ctypes.Structure):
    """`padgs::BlendGradientArguments`."""

    _fields_ = [
        ("forward", BlendArguments),
        *fields(Pointer, "grad_image", "grad_transmittance", "grad_depth", "moments", "grad_rays"),
        ("absolute", ctypes.c_int32),
    ]


class HeadWeights(ctypes.Structure):
    """`padgs::HeadWeights`."""

    _fields_ = fields(Pointer, "w1", "b1", "w2", "b2")


class DecodeArguments(ctypes.Structure):
    """`padgs::DecodeArguments`."""

    _fields_ = [
        ("anchors", ctypes.c_int64),
        *fields(ctypes.c_int32, "offsets", "inputs", "hidden"),
        *fields(HeadWeights, "opacity", "color", "covariance"),
        *fields(Pointer, "input_rows", "positions", "offset_rows", "log_scales", "attenuation"),
        *fields(Pointer, "raw_opacities", "slot_start", "slots"),
        *fields(Pointer, "means", "quats", "scales", "opacities", "colors"),
    ]


class DecodeGradientArguments(ctypes.Structure):
    """`padgs::DecodeGradientArguments`."""

    _fields_ = [
        ("forward", DecodeArguments),
        *fields(Pointer, "means", "quats", "scales", "opacities", "colors"),
        ("features", ctypes.c_int32),
        *fields(Pointer, "features_out", "offsets_out", "log_scales_out", "weights_out"),
    ]


class LossArguments(ctypes.Structure):
    """`padgs::LossArguments`."""

    _fields_ = [
        *fields(ctypes.c_int32, "width", "height"),
        *fields(Pointer, "image", "target", "weight"),
        *fields(ctypes.c_int64, "weight_row_stride", "weight_column_stride"),
        *fields(ctypes.c_float, "lambda_l1", "normalizer"),
        *fields(Pointer, "workspace", "gradient"),
    ]


STRUCTURES = (Camera, Inputs, Gradients, BlendGradientArguments, DecodeGradientArguments, LossArguments)
SIGNATURES = {
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
    "padgs_blend_forward": ([Pointer], None),
    "padgs_blend_backward": ([Pointer], None),
    "padgs_decode_select": ([Pointer], None),
    "padgs_decode_place": ([Pointer], None),
    "padgs_decode_backward": ([Pointer], None),
    "padgs_photometric_loss": ([Pointer], ctypes.c_double),
    "padgs_loss_workspace": ([Int32, Int32], Int64),
    "padgs_measure_fma": ([Int64], ctypes.c_double),
    "padgs_measure_triad": ([Pointer, Pointer, Int64], ctypes.c_double),
}


def pointer(tensor: Tensor | None) -> int | None:
    """Address of a contiguous tensor, or None."""
    if tensor is None:
        return None
    assert tensor.is_contiguous(), f"native code takes contiguous tensors, got strides {tensor.stride()}"
    return tensor.data_ptr()


@functools.cache
def library() -> ctypes.CDLL:
    """The loaded CPU library.

    Raises:
        OSError: it was not built (no compiler at install time), does not load, or was built from other sources; the
            message says where it was sought.
    """
    return declared(opened("padgs_cpu", "a C++ compiler"), SIGNATURES, "padgs_structure_bytes", STRUCTURES)


def opened(stem: str, needs: str) -> ctypes.CDLL:
    """The library lib`stem` of this package, or of the folder PADGS_LIBRARY_DIR while someone works on the kernels.

    Raises:
        OSError: it is not there, because `needs` was not when padgs was installed, or does not load.
    """
    suffix = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
    name = ("" if sys.platform == "win32" else "lib") + stem + suffix
    folders = [Path(folder) for folder in _package_folders()]
    if "PADGS_LIBRARY_DIR" in os.environ:
        folders.insert(0, Path(os.environ["PADGS_LIBRARY_DIR"]))
    for folder in folders:
        if (folder / name).exists():
            return ctypes.CDLL(str(folder / name))
    raise OSError(
        f"{name} not found in {', '.join(map(str, folders))}; install padgs where {needs} is on the PATH, "
        "or render with backend=torch"
    )


def _package_folders() -> list[str]:
    spec = importlib.util.find_spec("padgs.native")
    return list(spec.submodule_search_locations or []) if spec else []


def declared(
    loaded: ctypes.CDLL, signatures: Mapping[str, tuple[list, Any]], bytes_of: str, structures: Sequence[type]
) -> ctypes.CDLL:
    """The library with the types of its functions set, if it is one of ours and of this version.

    Raises:
        OSError: a function is missing, or a structure of the library has another size.
    """
    for name, (arguments, result) in signatures.items():
        if not hasattr(loaded, name):
            raise OSError(f"{loaded._name} is of another version, without {name}; build it again")
        function = getattr(loaded, name)
        function.argtypes, function.restype = arguments, result
    for index, structure in enumerate(structures):  # what is laid out differently would be read as nonsense
        if getattr(loaded, bytes_of)(index) != ctypes.sizeof(structure):
            raise OSError(f"{loaded._name} is of another version, with another {structure.__name__}; build it again")
    return loaded


@functools.cache
def available() -> bool:
    """Whether the native CPU library is built and loads."""
    try:
        library()
    except OSError:
        return False
    return True
