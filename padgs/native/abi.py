"""The structures of the native libraries, named as in namespace padgs of `csrc/abi.h` unless a docstring says it."""

import ctypes

from torch import Tensor

Pointer = ctypes.c_void_p
Int32, Int64 = ctypes.c_int32, ctypes.c_int64
GRADIENT_SUMS = 16  # floats per (Gaussian, tile) instance in the backward pass
ABSGRAD_SUM = 14  # index of the absolute positional gradient among them
REMOVAL = 4  # floats per instance of leave-one-out: changes of error and image, sum and largest contribution


def fields(kind: type, *names: str) -> list[tuple[str, type]]:
    """Return members of a structure that have one type."""
    return [(name, kind) for name in names]


class NativeCamera(ctypes.Structure):
    """`padgs::Camera`."""

    _fields_ = [
        *fields(Int32, "width", "height", "projection", "model"),
        ("cam_from_world", ctypes.c_float * 12),
        *fields(ctypes.c_float, "near_radius", "low_pass"),
        *fields(Int32, "wrap", "square"),
        *fields(ctypes.c_float, "fx", "fy", "cx", "cy", "widen", "off_panorama"),
        *fields(Int32, "compensate", "cull_ellipsoids"),
        ("steepness", ctypes.c_float),
    ]


class TileGrid(ctypes.Structure):
    _fields_ = [*fields(Int32, "width", "height", "first_row", "end_row"), *fields(Pointer, "level", "row_start")]


class Inputs(ctypes.Structure):
    _fields_ = [("count", Int64), *fields(Pointer, "means", "quats", "scales", "opacities", "colors", "mean_offsets")]


class Gradients(ctypes.Structure):
    _fields_ = fields(Pointer, "means", "quats", "scales", "opacities", "colors", "mean_offsets", "pose")


class RayPointers(ctypes.Structure):
    """`padgs::Rays`."""

    _fields_ = fields(Pointer, "column_sine", "column_cosine", "row_sine", "row_cosine", "table")


class BlendArguments(ctypes.Structure):
    _fields_ = [
        ("grid", TileGrid),
        *fields(Int32, "projection", "wrap", "core_size"),
        ("steepness", ctypes.c_float),
        ("rays", RayPointers),
        *fields(Pointer, "footprints", "tile_start", "instances", "background"),
        *fields(Pointer, "image", "transmittance", "depth", "last", "pair_counts", "cores", "core_start"),
    ]


class BlendGradientArguments(ctypes.Structure):
    _fields_ = [
        ("forward", BlendArguments),
        *fields(Pointer, "grad_image", "grad_transmittance", "grad_depth", "moments", "grad_rays"),
        ("absgrad", Int32),
    ]


class LeaveOneOutArguments(ctypes.Structure):
    _fields_ = [("forward", BlendArguments), *fields(Pointer, "target", "weight", "removals")]


class HeadWeights(ctypes.Structure):
    _fields_ = fields(Pointer, "w1", "b1", "w2", "b2")


class DecodeArguments(ctypes.Structure):
    _fields_ = [
        ("anchors", Int64),
        *fields(Int32, "offsets", "inputs", "hidden"),
        *fields(HeadWeights, "opacity", "color", "covariance"),
        *fields(Pointer, "input_rows", "positions", "offset_rows", "log_scales", "attenuation"),
        *fields(Pointer, "raw_opacities", "slot_start", "slots"),
        *fields(Pointer, "means", "quats", "scales", "opacities", "colors"),
    ]


class DecodeGradientArguments(ctypes.Structure):
    _fields_ = [
        ("forward", DecodeArguments),
        *fields(Pointer, "means", "quats", "scales", "opacities", "colors"),
        ("features", Int32),
        *fields(Pointer, "features_out", "offsets_out", "log_scales_out", "weights_out"),
    ]


class LossArguments(ctypes.Structure):
    _fields_ = [
        *fields(Int32, "width", "height"),
        *fields(Pointer, "image", "target", "weight"),
        *fields(Int64, "weight_row_stride", "weight_column_stride"),
        *fields(ctypes.c_float, "lambda_l1", "normalizer"),
        *fields(Pointer, "workspace", "gradient"),
    ]


class RoughnessArguments(ctypes.Structure):
    _fields_ = [
        *fields(Int32, "width", "height", "wrap"),
        *fields(ctypes.c_float, "nearest", "edges", "jump"),
        *fields(Pointer, "image", "transmittance", "depth", "row_weight", "workspace", "gradient"),
    ]


class SplatArguments(ctypes.Structure):
    _fields_ = [
        ("count", Int64),
        *fields(Int32, "degree", "stored", "probe_width"),
        ("center", ctypes.c_float * 3),
        ("tiny", ctypes.c_float),
        *fields(Pointer, "means", "log_scales", "opacity_logits", "dc", "rest", "probe"),
        *fields(Pointer, "moved", "scales", "opacities", "colors", "pulls"),
        *fields(Pointer, "grad_moved", "grad_scales", "grad_opacities", "grad_colors", "grad_pulls"),
        *fields(Pointer, "grad_means", "grad_log_scales", "grad_opacity_logits", "grad_dc", "grad_rest", "grad_probe"),
    ]


def pointer(tensor: Tensor | None) -> int | None:
    """Return the address of a contiguous tensor, or None."""
    if tensor is None:
        return None
    assert tensor.is_contiguous(), f"native code takes contiguous tensors, got strides {tensor.stride()}"
    return tensor.data_ptr()
