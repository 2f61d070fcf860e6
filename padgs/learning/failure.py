"""The ways in which training breaks, and how they are recognised."""

from __future__ import annotations

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


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means that memory ran out; torch says so in the text of a RuntimeError only."""
    return isinstance(error, MemoryError) or any(text in str(error) for text in OUT_OF_MEMORY_MESSAGES)
