"""Selection of the tests of the emulated GPU that run by default."""

import pytest
import torch
from support import cuda_engine

# The definition, the golden cases and bad input; the rest of what every engine is asked takes minutes at this pace.
QUICK = {
    "test_absgrad",
    "test_contract",
    "test_cuda_backend",
    "test_cuda_loss",
    "test_cuda_tiles",
    "test_golden",
    "test_hybrid_rendering",
    "test_leave_one_out",
    "test_near_cull",
    "test_parity",
}


EXTREME = {"test_extremes", "test_invariants"}


@pytest.hookimpl(tryfirst=True)  # before marks are looked at
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all other tests of the emulated GPU slow, and extremes in float64."""
    for item in items:
        engine = getattr(item, "callspec", None)
        if engine and item.path.stem in EXTREME and engine.params.get("dtype") == torch.float64:
            item.add_marker(pytest.mark.slow)  # float32 runs the same code, and overflows first
        if engine is None or engine.params.get("backend") != "cuda" or cuda_engine.ON_GPU:
            continue
        if item.path.stem not in QUICK or "erp_many" in item.name:
            item.add_marker(pytest.mark.slow)
