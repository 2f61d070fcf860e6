"""Whether two states are the same, whenever they were made."""

import torch

from padgs.training.model import State

TIMES = {"seconds": 0, "cpu_seconds": 0, "durations": [], "began": 0}


def assert_same_but_time(a: State, b: State) -> None:
    assert a.values | TIMES == b.values | TIMES
    assert a.tensors.keys() == b.tensors.keys()
    for name, tensor in a.tensors.items():
        assert torch.equal(tensor, b.tensors[name]), name
