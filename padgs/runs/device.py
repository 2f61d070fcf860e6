"""Where a run trains, renders and is scored: everything follows the tensors of its scene and of its checkpoint."""

from __future__ import annotations

import warnings

import torch

from padgs.native import cuda
from padgs.render import RenderConfig

DEVICES = ("auto", "cpu", "cuda")


def chosen(name: str, render: RenderConfig) -> torch.device:
    """The device that `run.device` stands for; auto, its default, is a GPU that can draw this, else the CPU.

    Warns where a GPU is left alone because the library for it is not there, or was not compiled for it.

    Raises:
        ValueError: cuda where torch finds no GPU, or backend cuda on the CPU.
        OSError: backend cuda, whose library is not built.
    """
    if (name == "cuda" or render.backend == "cuda") and not torch.cuda.is_available():
        why = "torch finds no GPU with a working driver" if torch.version.cuda else "this torch is built without CUDA"
        wish, way_out = ("run.device", "cpu or auto") if name == "cuda" else ("render.backend", "auto, cpu or torch")
        raise ValueError(f"{wish}=cuda, but {why}; mend that, or set {wish}={way_out}")
    if render.backend == "cuda":
        if name == "cpu":
            raise ValueError("render.backend=cuda draws on a GPU only, not with run.device=cpu; set run.device=auto")
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
