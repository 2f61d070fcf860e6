"""The structures that the native libraries take, as `csrc/abi.h` has them: plain C, pointers and sizes."""

from __future__ import annotations

import ctypes

from torch import Tensor

Pointer = ctypes.c_void_p
Int32, Int64 = ctypes.c_int32, ctypes.c_int64


def fields(kind: type, *names: str) -> list[tuple[str, type]]:
    """Members of a structure that are of one type."""
    return [(name, kind) for name in names]


class NativeCamera(ctypes.Structure):
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


class RayPointers(ctypes.Structure):
    """`padgs::Rays`."""

    _fields_ = fields(Pointer, "column_sine", "column_cosine", "row_sine", "row_cosine", "table")


class BlendArguments(ctypes.Structure):
    """`padgs::BlendArguments`."""

    _fields_ = [
        ("grid", TileGrid),
        *fields(ctypes.c_int32, "projection", "wrap", "core_size"),
        ("rays", RayPointers),
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


def pointer(tensor: Tensor | None) -> int | None:
    """Address of a contiguous tensor, or None."""
    if tensor is None:
        return None
    assert tensor.is_contiguous(), f"native code takes contiguous tensors, got strides {tensor.stride()}"
    return tensor.data_ptr()
