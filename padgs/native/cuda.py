"""libpadgs_cuda: its structures (`csrc/cuda/arguments.h`) and calls. Importing this module loads nothing.

The library contains kernels and its own CUDA runtime. It takes pointers to memory of the device and a stream; it
allocates nothing and never waits.
"""

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor

from padgs.native import abi
from padgs.native.abi import Int32, Int64, Pointer, fields
from padgs.native.loading import Library, declare, find_library, succeeds

OUT_OF_MEMORY = 2  # cudaErrorMemoryAllocation
NOT_COMPILED_FOR = (98, 209, 222)  # no such kernel, no image for this device, PTX newer than the driver


class Queue(ctypes.Structure):
    _fields_ = [("device", Int32), ("stream", Pointer)]


class TileTable(ctypes.Structure):
    _fields_ = fields(Int32, "width", "height", "first_row", "end_row")


class ProjectArguments(ctypes.Structure):
    _fields_ = [
        *(("camera", abi.NativeCamera), ("pose", Pointer), ("inputs", abi.Inputs)),
        *fields(Pointer, "footprints", "boxes", "depth_keys", "indices"),
        ("table", TileTable),
        ("counts", Pointer),
    ]


class ProjectGradientArguments(ctypes.Structure):
    _fields_ = [
        *(("camera", abi.NativeCamera), ("pose", Pointer), ("inputs", abi.Inputs)),
        *(("moments", Pointer), ("out", abi.Gradients)),
    ]


class SortArguments(ctypes.Structure):
    _fields_ = [
        ("scratch", Pointer),
        *fields(Int64, "scratch_bytes", "count"),
        *fields(Pointer, "keys", "sorted_keys", "values", "sorted_values"),
        ("bits", Int32),
    ]


class BinArguments(ctypes.Structure):
    _fields_ = [
        ("table", TileTable),
        *fields(Pointer, "boxes", "order"),
        ("visible", Int64),
        *fields(Pointer, "tiles", "slot_start", "reaches"),
        ("sort", SortArguments),
        ("tile_start", Pointer),
    ]


class BlendInputs(ctypes.Structure):
    _fields_ = [
        ("table", TileTable),
        *fields(Int32, "projection", "wrap", "core_size"),
        ("steepness", ctypes.c_float),
        ("rays", abi.RayPointers),
        *fields(Pointer, "footprints", "tile_start", "slots", "reaches", "background"),
        *fields(Pointer, "image", "transmittance", "depth", "last", "core", "tails", "pair_counts"),
    ]


class BlendGradientInputs(ctypes.Structure):
    _fields_ = [
        ("forward", BlendInputs),
        *fields(Pointer, "grad_image", "grad_transmittance", "grad_depth", "core_gradients"),
        *fields(Pointer, "moments", "grad_rays", "order", "slot_start"),
        ("visible", Int64),
        ("totals", Pointer),
        ("absgrad", Int32),
    ]


class RemovalInputs(ctypes.Structure):
    _fields_ = [("forward", BlendInputs), *fields(Pointer, "target", "weight", "removals")]


class DeviceLossArguments(ctypes.Structure):
    _fields_ = [("loss", abi.LossArguments), *fields(Pointer, "total", "block_sums")]


class DeviceSplatArguments(ctypes.Structure):
    _fields_ = [("splats", abi.SplatArguments), ("center", Pointer)]


class DeviceDecodeArguments(ctypes.Structure):
    _fields_ = [("decode", abi.DecodeArguments), ("room", Int64), *fields(Pointer, "color_logits", "covariance_logits")]


class DeviceDecodeGradientArguments(ctypes.Structure):
    _fields_ = [
        *(("gradient", abi.DecodeGradientArguments), ("room", Int64)),
        *fields(Pointer, "opacity_out", "color_out", "covariance_out"),
    ]


STRUCTURES = (
    *(Queue, ProjectArguments, ProjectGradientArguments, SortArguments, BinArguments, BlendInputs),
    *(BlendGradientInputs, RemovalInputs, DeviceLossArguments, DeviceSplatArguments, DeviceDecodeArguments),
    DeviceDecodeGradientArguments,
)
CALLS = (  # that take a queue and a structure
    *("project", "sort", "blend", "blend_backward", "leave_one_out", "project_backward", "splats", "decode_place"),
    *("decode_take_back", "photometric_loss"),
)
SIGNATURES: dict[str, tuple[list, Any]] = {
    "padgs_cuda_structure_bytes": ([Int32], Int64),
    "padgs_cuda_device_type": ([], ctypes.c_char_p),
    "padgs_cuda_architectures": ([], ctypes.c_char_p),
    "padgs_cuda_versions": ([Pointer, Pointer], None),
    "padgs_cuda_check": ([Pointer], Int32),
    "padgs_cuda_error": ([Int32], ctypes.c_char_p),
    "padgs_cuda_scratch_bytes": ([Pointer, Int64], Int64),
    "padgs_cuda_pose_blocks": ([Int64], Int64),
    "padgs_cuda_bin": ([Pointer, Pointer, Int32], Int32),
    "padgs_cuda_loss_blocks": ([Int32, Int32], Int64),
    **{f"padgs_cuda_{name}": ([Pointer, Pointer], Int32) for name in CALLS},
}


@functools.cache
def library() -> Library:
    """Return the loaded library; OSError if it is missing, does not load, or does not fit its callers or the driver."""
    loaded = declare(find_library("padgs_cuda", "nvcc and a GPU"), SIGNATURES, "padgs_cuda_structure_bytes", STRUCTURES)
    refuse_old_driver(loaded)
    return loaded


def refuse_old_driver(loaded: Library) -> None:
    """Raise OSError if the driver has an older major version of CUDA than the runtime of the library."""
    driver, built_with = Int32(), Int32()
    loaded.padgs_cuda_versions(ctypes.byref(driver), ctypes.byref(built_with))
    if 0 < driver.value // 1000 < built_with.value // 1000:
        has, wants = (f"{version.value // 1000}.{version.value % 1000 // 10}" for version in (driver, built_with))
        raise OSError(
            f"libpadgs_cuda was compiled by CUDA {wants}, but the driver supports CUDA {has}; update the driver, "
            f"install padgs with nvcc of CUDA {has} or older, or render with backend=torch"
        )


@functools.cache
def available() -> bool:
    """Return whether the library is built, loads and fits the driver, with or without a GPU that can run it."""
    return succeeds(library)


def require(device: torch.device) -> None:
    """Raise OSError or RuntimeError, as `library` and `queue` do, if nothing can be rendered on this device."""
    library()
    queue(device)


def device_type() -> str:
    """Return the torch device type of the library's tensors: cuda."""
    return library().padgs_cuda_device_type().decode()


def queue(device: torch.device) -> Queue:
    """Return the current torch stream of a device; RuntimeError if the kernels cannot run there."""
    if device.type != "cuda":
        return Queue(0, None)
    index = torch.cuda.current_device() if device.index is None else device.index
    check_device(index)
    return Queue(index, torch.cuda.current_stream(index).cuda_stream)


@functools.cache
def check_device(index: int) -> None:
    """Launch an empty kernel, once for each device; RuntimeError if it cannot run."""
    code = library().padgs_cuda_check(ctypes.byref(Queue(index, None)))
    if code in NOT_COMPILED_FOR:
        major, minor = torch.cuda.get_device_capability(index)
        raise RuntimeError(
            f"libpadgs_cuda is compiled for compute capabilities {library().padgs_cuda_architectures().decode()}; "
            f"{torch.cuda.get_device_name(index)} has {major}{minor}. Install padgs with "
            f"-C cmake.define.PADGS_CUDA_ARCHITECTURES={major}{minor}, or render with backend=torch"
        )
    raise_for(code, "padgs_cuda_check")


def call(name: str, where: Queue, *arguments: Any) -> None:
    """Call a function that returns a cudaError_t, which is raised; structures are passed by reference."""
    references = (ctypes.byref(a) if isinstance(a, ctypes.Structure) else a for a in arguments)
    raise_for(getattr(library(), name)(ctypes.byref(where), *references), name)


def raise_for(code: int, name: str) -> None:
    """Raise the exception of an error code; return for code 0."""
    if code == 0:
        return
    message = f"{name}: CUDA error {code}, {library().padgs_cuda_error(code).decode()}"
    raise torch.cuda.OutOfMemoryError(message) if code == OUT_OF_MEMORY else RuntimeError(message)


class HostCopy:
    """Integers on their way from a device to the host; neither waits for the other until they are used."""

    def __init__(self, values: Tensor) -> None:
        self._event = None
        device = values.device
        if device.type == "cuda":
            pinned = torch.empty(values.shape, dtype=values.dtype, device="cpu", pin_memory=True)
            values = pinned.copy_(values, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(device))
        self._values = values

    def values(self) -> list[int]:
        """Return the integers; waits until the device has computed them."""
        if self._event is not None:
            self._event.synchronize()
        return self._values.tolist()
