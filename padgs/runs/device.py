"""The device of a run: training, rendering and scoring follow the tensors of its scene and checkpoint."""

from __future__ import annotations

import warnings

import torch

from padgs.native import cuda
from padgs.render import RenderConfig

DEVICES = ("auto", "cpu", "cuda")


def choose_device(name: str, render: RenderConfig) -> torch.device:
    """Return the device for `run.device`; auto is a GPU that can render these settings, else the CPU.

    Warns if a GPU is not used because its library is missing or was not compiled for it.

    Raises:
        ValueError: cuda without a GPU, or backend cuda on the CPU.
        OSError: the library of backend cuda is not built.
    """
    if (name == "cuda" or render.backend == "cuda") and not torch.cuda.is_available():
        why = "torch finds no GPU with a working driver" if torch.version.cuda else "this torch is built without CUDA"
        wish, way_out = ("run.device", "cpu or auto") if name == "cuda" else ("render.backend", "auto, cpu or torch")
        raise ValueError(f"{wish}=cuda, but {why}; correct that, or set {wish}={way_out}")
    if render.backend == "cuda":
        if name == "cpu":
            raise ValueError("render.backend=cuda renders on a GPU only, not with run.device=cpu; set run.device=auto")
        cuda.library()
    if not torch.cuda.is_available() or name == "cpu":
        return torch.device("cpu")
    gpu = torch.device("cuda", torch.cuda.current_device())
    if name == "cuda":
        return gpu
    if render.backend not in ("auto", "cuda"):  # torch on a GPU is slower than the CPU
        return torch.device("cpu")
    try:
        cuda.require(gpu)
    except (OSError, RuntimeError) as error:
        warnings.warn(f"a GPU is here, but the CPU is used: {error}", stacklevel=2)
        return torch.device("cpu")
    return gpu
