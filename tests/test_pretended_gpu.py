"""The pretended GPU counts what a real one would make the host wait for, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from support.pretended_gpu import GPU, pretended_gpu
from torch import Tensor

WAITS: dict[str, Callable[[Tensor, Tensor], object]] = {
    "reading by a mask": lambda x, mask: x[mask],
    "writing by a mask": lambda x, mask: x.__setitem__(mask, x[:1]),
    "adding by a mask": lambda x, mask: x.__setitem__(mask, x[mask] + 1),
    "where it is not 0": lambda x, mask: x.nonzero(),
    "a number": lambda x, mask: x.sum().item(),
    "a number as an integer": lambda x, mask: int(mask.sum()),
    "a condition": lambda x, mask: bool(mask.any()),
    "a list": lambda x, mask: x.tolist(),
    "to the CPU": lambda x, mask: x.cpu(),
    "from the CPU": lambda x, mask: torch.zeros(4).to(GPU),
    "into a tensor there": lambda x, mask: x.copy_(torch.zeros(4)),
    "a list that becomes a tensor": lambda x, mask: torch.tensor([1.0, 2.0]).to(GPU),
    "a list that becomes a tensor there": lambda x, mask: torch.tensor([1.0, 2.0], device=GPU),
    "a list that becomes one like another": lambda x, mask: x.new_tensor([1.0, 2.0]),
    "different values": lambda x, mask: x.unique(),
    "a comparison of all": lambda x, mask: torch.equal(x, x),
    "a choice": lambda x, mask: x.masked_select(mask),
}
NONE: dict[str, Callable[[Tensor, Tensor], object]] = {
    "arithmetic": lambda x, mask: (x * 2 + 1).sum(),
    "where": lambda x, mask: torch.where(mask, x, 0),
    "rows by numbers": lambda x, mask: x[torch.arange(2, device=GPU)],
    "adding at numbers": lambda x, mask: x.__setitem__(torch.arange(2, device=GPU), x[:2] + 1),
    "zeros there": lambda x, mask: torch.zeros(4, device=GPU),
    "another type": lambda x, mask: x.double(),
    "a copy there": lambda x, mask: x.copy_(x + 1),
    "a slice": lambda x, mask: x[1:3],
}


@pytest.mark.parametrize("what", [*WAITS, *NONE])
def test_waits_are_counted_and_nothing_else(what: str):
    with pretended_gpu() as waits:
        x = torch.arange(4.0).to(GPU)
        mask = x > 1
        waits.clear()
        (WAITS | NONE)[what](x, mask)
        assert bool(waits) == (what in WAITS), waits


def test_tensors_of_two_devices_do_not_meet():
    with pretended_gpu(), pytest.raises(RuntimeError, match="add of tensors on two devices"):
        torch.zeros(4).to(GPU) + torch.zeros(4)
