"""The mean angular size: of what is known, in any units, and natively as the definition has it."""

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from padgs.gaussians import Gaussians
from padgs.methods.plus import model
from padgs.methods.plus.model import mean_angular_size
from padgs.native import cpu
from padgs.scene import View


def gaussians_at(means: torch.Tensor, scales: torch.Tensor) -> Gaussians:
    count = len(means)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).to(means).expand(count, 4)
    return Gaussians(means, quats, scales, means.new_ones(count), means.new_zeros(count, 3))


def view_from(center: tuple[float, float, float]) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.tensor(center, dtype=torch.float64)
    return View("v", pose, 32, 16)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e6])
def test_it_is_scale_over_distance_but_none_is_less_than_near(dtype, unit):
    means = unit * torch.tensor([[1.0, 0.0, 4.0], [1.0, 2.0, 0.0], [1.0, 0.0, 0.001]], dtype=dtype)
    scales = unit * torch.tensor([[0.4, 0.2, 0.6], [0.1, 0.1, 0.1], [0.3, 0.3, 0.3]], dtype=dtype)
    found = mean_angular_size(gaussians_at(means, scales), view_from((unit, 0.0, 0.0)), near=0.5 * unit)
    assert found.item() == pytest.approx((0.1 + 0.05 + 0.6) / 3, rel=1e-6)


@pytest.mark.skipif(not cpu.available(), reason="the native CPU library was not built")
@pytest.mark.parametrize("count", [1, 16, 1000, 3000])
def test_the_native_value_and_gradient_are_those_of_the_definition(monkeypatch, generator, count):
    means, scales = torch.randn(count, 3, generator=generator), torch.rand(count, 3, generator=generator)
    found = []
    for native in (True, False):
        monkeypatch.setattr(model.cpu, "available", lambda native=native: native)
        leaf = scales.clone().requires_grad_()
        size = mean_angular_size(gaussians_at(means, leaf), view_from((0.1, 0.2, 0.3)), near=0.2)
        found.append((size.item(), *torch.autograd.grad(3 * size, leaf)))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-5)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("place", ["means", "scales"])
def test_what_is_no_number_reaches_the_loss(place, generator):
    values = {"means": torch.randn(20, 3, generator=generator), "scales": torch.rand(20, 3, generator=generator)}
    values[place][7, 1] = math.nan
    assert mean_angular_size(gaussians_at(**values), view_from((0.0, 0.0, 0.0)), near=0.1).isnan()


def test_no_instruction_set_takes_what_is_no_number_for_near():
    """Which of two numbers a maximum takes, if one is none, differs between them; this machine's own is above."""
    code = (
        "import torch; from test_angular_size import gaussians_at, view_from, mean_angular_size as size; "
        "means = torch.full((20, 3), float('nan')); "
        "print(size(gaussians_at(means, torch.ones(20, 3)), view_from((0.0, 0.0, 0.0)), near=0.1).item())"
    )
    for isa in ("baseline", "avx2"):
        path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
        environment = {**os.environ, "PYTHONPATH": path, "PADGS_ISA": isa}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
        assert done.stdout.strip() == "nan", done.stderr
