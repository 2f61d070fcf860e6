import pytest
import torch

from padgs.training.health import is_out_of_memory
from padgs.training.optimizer import first_non_finite


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
def test_first_bad_entry_is_named(bad):
    tensor = torch.zeros(3, 2)
    tensor[1, 0] = bad
    assert first_non_finite({"fine": torch.ones(4), "means": tensor, "also": tensor}) == f"means[1, 0] is {bad}"


def test_large_empty_missing_and_integer_tensors_are_fine():
    huge = torch.full((100,), 3e38)
    assert first_non_finite({"a": huge, "b": torch.zeros(0, 3), "c": None, "d": torch.arange(3)}) is None


def test_scalars_have_no_index():
    assert first_non_finite({"loss": torch.tensor(float("nan"))}) == "loss is nan"


def test_the_allocator_of_torch_is_recognised():
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 60, dtype=torch.uint8)
    assert is_out_of_memory(caught.value)
    assert is_out_of_memory(MemoryError())
    assert not is_out_of_memory(RuntimeError("shapes differ"))
