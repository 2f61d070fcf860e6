"""What tests mean by backend cuda: the GPU where there is one, else the same kernels on the CPU (emulation.h).

Importing this module arranges it for the whole process. On a GPU, tensors of a test stay on the CPU and take a trip.
"""

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from padgs.gaussians import Gaussians
from padgs.geometry.camera import RayTable
from padgs.native import cuda, loading
from padgs.render import BACKENDS, Rendering
from padgs.render.backends import cuda as cuda_backend
from padgs.render.contract import Removals, Request
from padgs.render.leave_one_out import BACKENDS as SCORERS

os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # deterministic; older torch reads it but once
HERE = Path(__file__).parents[1] / "render" / "cuda"
SOURCES = Path(cuda.__file__).parent / "csrc" / "cuda"
COMPILER = shutil.which("c++") or shutil.which("g++")
FUSED = ("-mfma", "-ffp-contract=fast")
FUSES = Path("/proc/cpuinfo").exists() and " fma " in Path("/proc/cpuinfo").read_text()
ON_GPU = torch.cuda.is_available() and cuda.available()
real_library = cuda.library


@functools.cache
def emulated_library() -> ctypes.CDLL:
    """Return the kernels compiled for the host; takes seconds, once in a process."""
    loaded = compiled("padgs_cuda", sorted(SOURCES.glob("*.cu")))
    return loading.declare(loaded, cuda.SIGNATURES, "padgs_cuda_structure_bytes", cuda.STRUCTURES)


@functools.cache
def layout_library() -> ctypes.CDLL:
    """Return the library of layout_check.cpp."""
    return compiled("layout", [HERE / "layout_check.cpp"])


@functools.cache
def fused_library() -> ctypes.CDLL:
    """Return the library as `emulated_library` does, with products fused into sums as nvcc does."""
    return compiled("padgs_cuda_fused", [SOURCES / "blend.cu", SOURCES / "hybrid.cu"], *FUSED)


def compiled(name: str, sources: list[Path], *more: str) -> ctypes.CDLL:
    """Compile C++ or CUDA sources to a shared library, once for all processes of a test run."""
    flags = ["-std=c++17", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror", "-DPADGS_EMULATED"]
    flags += ["-Wno-unknown-pragmas"]  # nvcc's
    flags += ["-fno-gnu-unique"]  # or the emulations of two libraries would be one
    flags += ["-fsanitize=bounds", "-fsanitize-undefined-trap-on-error"]  # of arrays: ends the process
    return _loaded(name, [str(COMPILER), *flags, *more, f"-I{HERE}", f"-I{SOURCES}", "-x", "c++", *map(str, sources)])


def _loaded(name: str, command: list[str]) -> ctypes.CDLL:
    digest = hashlib.sha256("\0".join(command).encode()).hexdigest()[:12]
    target = Path(os.environ["PADGS_TESTS_SHARED"], f"lib{name}-{digest}.so")
    with FileLock(f"{target}.lock"):
        if not target.exists():
            draft = target.with_suffix(".draft")
            done = subprocess.run([*command, "-o", str(draft)], capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            draft.rename(target)
    return ctypes.CDLL(str(target))


def on_gpu(request: Request) -> Request:
    """The same, differentiably."""
    tensors = {name: value.cuda() for name, value in vars(request).items() if isinstance(value, torch.Tensor)}
    gaussians = Gaussians(**{name: value.cuda() for name, value in vars(request.gaussians).items()})
    camera = request.camera
    if isinstance(camera, RayTable):
        camera = RayTable(camera.table.cuda(), camera.focal)
    return replace(request, gaussians=gaussians, camera=camera, **tensors)


def rasterize_on_gpu(request: Request) -> Rendering:
    """Call `cuda_backend.rasterize` for tensors on the CPU, differentiably."""
    drawn = cuda_backend.rasterize(on_gpu(request))
    tensors = {name: getattr(drawn, name).cpu() for name in ("image", "transmittance", "depth", "visible")}
    return replace(drawn, **tensors)


def leave_one_out_on_gpu(request: Request, target: torch.Tensor, weight: torch.Tensor) -> Removals:
    """Call `cuda_backend.leave_one_out` for tensors on the CPU."""
    found = cuda_backend.leave_one_out(on_gpu(request), target.cuda(), weight.cuda())
    return Removals(*(tensor.cpu() for tensor in vars(found).values()))


if ON_GPU:
    BACKENDS["cuda"] = f"{__name__}:rasterize_on_gpu"
    SCORERS["cuda"] = f"{__name__}:leave_one_out_on_gpu"
else:
    cuda.library = emulated_library


needs_engine = pytest.mark.skipif(not ON_GPU and COMPILER is None, reason="no GPU, and no C++ compiler to emulate one")


def marks() -> list:
    """Return the pytest marks of tests of backend cuda."""
    return [pytest.mark.cuda] if ON_GPU else [needs_engine]
