import pytest
import torch

from padgs.training.health import is_out_of_memory
from padgs.training.optimizer import first_non_finite

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("tensors", "found"),
    [
        (
            {"fine": torch.ones(4), "means": torch.tensor([[0.0], [NAN]]), "also": torch.tensor(NAN)},
            "means[1, 0] is nan",
        ),
        ({"means": torch.tensor([0.0, INF])}, "means[1] is inf"),
        ({"means": torch.tensor([-INF])}, "means[0] is -inf"),
        ({"loss": torch.tensor(NAN)}, "loss is nan"),
        ({"a": torch.full((9,), 3e38), "b": torch.zeros(0, 3), "c": None, "d": torch.arange(3)}, None),
    ],
)
def test_the_first_bad_entry_is_named(tensors, found):
    assert first_non_finite(tensors) == found


def test_the_allocator_of_torch_is_recognised():
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 60, dtype=torch.uint8)
    assert is_out_of_memory(caught.value) and is_out_of_memory(MemoryError())
    assert not is_out_of_memory(RuntimeError("shapes differ"))
