"""What tests mean by backend cuda: the GPU where there is one, else the same kernels on the CPU (emulation.h).

Importing this module arranges it for the whole process. On a GPU, tensors of a test stay on the CPU and take a trip.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import shutil
import subprocess
import tempfile
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from padgs.camera import RayTable
from padgs.render import BACKENDS, Rendering, cuda_backend, cuda_native, native

SOURCES = Path(cuda_native.__file__).parent / "csrc" / "cuda"
COMPILER = shutil.which("c++") or shutil.which("g++")
ON_GPU = torch.cuda.is_available() and cuda_native.available()
real_library = cuda_native.library


@functools.cache
def emulated_library() -> ctypes.CDLL:
    """The kernels compiled for the host; seconds, once in a process."""
    folder = Path(tempfile.mkdtemp(prefix="padgs-emulated-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    target = folder / "libpadgs_cuda.so"
    flags = ["-std=c++17", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror", "-DPADGS_EMULATED"]
    sources = [str(path) for path in sorted(SOURCES.glob("*.cu"))]
    command = [str(COMPILER), *flags, f"-I{Path(__file__).parent}", "-x", "c++", *sources, "-o", str(target)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    loaded = ctypes.CDLL(str(target))
    return native.declared(loaded, cuda_native.SIGNATURES, "padgs_cuda_structure_bytes", cuda_native.STRUCTURES)


def rasterize_on_gpu(gaussians, cam_from_world, camera, options, background, probe=None) -> Rendering:
    """`cuda_backend.rasterize` for tensors on the CPU; gradients find their way back."""
    gaussians = type(gaussians)(**{field.name: getattr(gaussians, field.name).cuda() for field in fields(gaussians)})
    if isinstance(camera, RayTable):
        camera = RayTable(camera.table.cuda(), camera.focal)
    probe = None if probe is None else probe.cuda()
    drawn = cuda_backend.rasterize(gaussians, cam_from_world.cuda(), camera, options, background.cuda(), probe)
    tensors = {name: getattr(drawn, name).cpu() for name in ("image", "transmittance", "depth", "visible")}
    return replace(drawn, **tensors)


if ON_GPU:
    BACKENDS["cuda"] = "cuda_engine:rasterize_on_gpu"
else:
    cuda_native.library = emulated_library


def marks() -> list:
    """What an engine of backend cuda is marked with."""
    if ON_GPU:
        return [pytest.mark.cuda]
    return [pytest.mark.skipif(COMPILER is None, reason="no GPU, and no C++ compiler to emulate one")]
