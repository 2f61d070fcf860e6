"""Attributes of explicit Gaussians on the GPU, or emulated, against their definition: values and gradients."""

import pytest
import torch
from support import cuda_engine
from support.splat_cases import assert_matches_definition, evaluated, splats_of

from padgs.methods.splats import native_splats
from padgs.native import LIBRARIES
from padgs.scene import View

pytestmark = [*cuda_engine.marks()]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"
POSE = torch.eye(4)
POSE[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
VIEW = View("v", POSE.to(DEVICE), 32, 16)


@pytest.mark.parametrize("count", [1, 128, 300])
@pytest.mark.parametrize("width", [0, 3, 4])
@pytest.mark.parametrize("stored", [0, 1, 2, 3])
def test_the_gpu_matches_the_definition(monkeypatch, generator, stored: int, width: int, count: int):
    splats = splats_of(count, stored, -POSE[:3, 3], generator).to(DEVICE)
    assert_matches_definition(splats, VIEW, width, native_splats.call_cuda, monkeypatch, tolerance=2e-6)


def test_nan_stays_nan(monkeypatch: pytest.MonkeyPatch, generator: torch.Generator):
    splats = splats_of(5, 3, -POSE[:3, 3], generator).to(DEVICE)
    splats.active_degree = 3
    splats.sh_rest.data[2, 4, 1] = float("nan")
    colors = evaluated(splats, VIEW, 0, native_splats.call_cuda, monkeypatch)[3]
    assert colors.isnan().nonzero().tolist() == [[2, 1]]


def test_supported_inputs(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(LIBRARIES, DEVICE, native_splats.cuda)
    means, center = torch.zeros(2, 3, device=DEVICE), torch.zeros(3, device=DEVICE)
    assert native_splats.native_call(means, center) is native_splats.call_cuda
    assert native_splats.native_call(means.double(), center) is None
    assert native_splats.native_call(means, center.requires_grad_()) is None
