"""Numbers that a GPU has computed, for a host that has other things to do until they are there."""

from __future__ import annotations

import torch
from torch import Tensor


class Reading:
    """Numbers on their way to the host, which does other things meanwhile, and which the device need not stop for."""

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
        """The numbers; waits until the device has got that far."""
        if self._event is not None:
            self._event.synchronize()
        return self._values.tolist()
