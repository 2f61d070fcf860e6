"""Where a run trains, renders and is scored: everything follows the tensors of its scene and of its checkpoint."""

from __future__ import annotations

import torch

from padgs.native import cuda
from padgs.render.config import RenderConfig

DEVICES = ("auto", "cpu", "cuda")


def chosen(name: str, render: RenderConfig) -> torch.device:
    """The device that `run.device` stands for; auto, its default, is a GPU that can draw this, else the CPU.

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
    draws = render.backend in ("auto", "cuda") and cuda.available()  # there, and faster than the CPU does
    on_gpu = name == "cuda" or (name == "auto" and torch.cuda.is_available() and draws)
    return torch.device("cuda", torch.cuda.current_device()) if on_gpu else torch.device("cpu")
