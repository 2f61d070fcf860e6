"""The ways in which training breaks, and how they are recognised."""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor

OUT_OF_MEMORY_MESSAGES = ("can't allocate memory", "not enough memory", "out of memory", "bad_alloc")


class Failure(RuntimeError):
    """Training cannot go on; `status` is one of `padgs.results.STATUSES` and enters the tables as such."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def first_non_finite(tensors: Mapping[str, Tensor | None]) -> str | None:
    """Name and first bad entry of the first tensor that holds a NaN or an infinity; None where all are finite.

    >>> first_non_finite({"a": torch.zeros(2), "b": torch.tensor([[0.0, float("nan")]]), "c": None})
    'b[0, 1] is nan'
    """
    for name, tensor in tensors.items():
        if tensor is None or torch.isfinite(tensor).all():
            continue
        index = (~torch.isfinite(tensor)).nonzero()[0].tolist()
        return f"{name}{index if index else ''} is {tensor[tuple(index)].item()}"
    return None


def memory_reason(error: BaseException) -> str:
    """What an error says that means that memory ran out, in words for who chose the sizes, not for who allocated.

    >>> memory_reason(RuntimeError("[enforce fail at x.cpp:90] . DefaultCPUAllocator: can't allocate memory: you tried "
    ...     "to allocate 8000000000 bytes. Error code 12 (Cannot allocate memory)"))
    '8.0 GB more were asked for than there are; use smaller panoramas (data.width) or fewer Gaussians'
    """
    way_out = "use smaller panoramas (data.width) or fewer Gaussians"
    if isinstance(error, MemoryError) and str(error):
        return str(error)  # of a limit of ours, or of an array that is named
    if asked := re.search(r"allocate ([\d.]+) ?([KMGT]iB|bytes)", str(error)):
        size = f"{float(asked[1]) / 1e9:.1f} GB" if asked[2] == "bytes" else f"{asked[1]} {asked[2]}"
        return f"{size} more were asked for than there are; {way_out}"
    return way_out


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means that memory ran out; torch says so in the text of a RuntimeError only."""
    return isinstance(error, MemoryError) or any(text in str(error) for text in OUT_OF_MEMORY_MESSAGES)
