"""Number of waits of the host during training, with emulated kernels on a pretended GPU.

Numbers that are read beside the drawing (`HostCopy`) are no wait: the device goes on with what it has.
"""

from collections import Counter
from contextlib import contextmanager
from itertools import islice

import pytest
import torch
from support import cuda_engine
from support.pretended_gpu import GPU, pretended_gpu
from torch import Tensor

from padgs.apps.bench.workload import Size, build, resident
from padgs.methods.anchors.growth import GrowthOptions
from padgs.methods.anchors.method import AnchorModel
from padgs.methods.splats.densification import POSITIONAL_GRADIENTS
from padgs.methods.splats.method import SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.native import LIBRARIES, cuda
from padgs.native.cuda import HostCopy
from padgs.native.loading import Stage, call_hook
from padgs.render import RenderConfig, RenderOptions
from padgs.render.backends import cuda as cuda_backend
from padgs.training.loop import Trainer
from padgs.training.loss import EVALUATIONS
from padgs.training.options import Budget, TrainOptions

pytestmark = pytest.mark.skipif(cuda_engine.ON_GPU or cuda_engine.COMPILER is None, reason="for the emulation")
SIZE = Size(32, 16, 100, views=3)
STEPS = 6


@pytest.fixture(autouse=True)
def kernels_are_there(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cuda, "device_type", lambda: GPU.type)
    monkeypatch.setitem(LIBRARIES, GPU.type, cuda)
    monkeypatch.setitem(EVALUATIONS, GPU.type, EVALUATIONS["cuda"])
    monkeypatch.setattr(HostCopy, "values", lambda reading: reading._values.held.tolist())
    monkeypatch.setattr(cuda_backend, "_capacities", {})


def trained() -> tuple[Trainer, list[Counter[str]]]:
    """Return what made the host wait in each of several iterations without densification."""
    work = build(SIZE)
    with pretended_gpu() as waits:
        growth = GrowthOptions(statistics_from=0, grow_until=10**6, grow_from=10**6)
        anchors = work.model.to(GPU)
        model = AnchorModel(anchors, RenderOptions(), "cuda", growth=growth, extent=1.0, iterations=1000)
        trainer = Trainer(model, resident(work.scene, GPU), Budget(1000))
        return trainer, steps_of(trainer, waits)


def steps_of(trainer: Trainer, waits: Counter[str]) -> list[Counter[str]]:
    """Train; return what made the host wait in each iteration."""
    waited = []
    waits.clear()
    for _ in islice(trainer.records(), STEPS):
        waited.append(Counter(waits))
        waits.clear()
    return waited


def stage_of(called: list[str]) -> Stage:
    """Record the names of called functions of the library."""

    @contextmanager
    def stage(name: str):
        called.append(name)
        yield

    return stage


def learned(trainer: Trainer) -> dict[str, Tensor]:
    """Return all trained state, densification statistics included."""
    with pretended_gpu():
        return {name: tensor.cpu() for name, tensor in trainer.state().tensors.items()}


def test_padgs_iterations_do_not_wait(monkeypatch: pytest.MonkeyPatch):
    trainer, waited = trained()
    assert waited[0] and waited[2:] == [Counter()] * (STEPS - 2), waited  # the first counts Gaussians and instances
    ahead = learned(trainer)
    monkeypatch.setattr("padgs.methods.anchors.method.resolve_backend", lambda *_: "another")
    exact, waited = trained()
    assert all(waited), "with as many rows as there are Gaussians it waits"
    for name, tensor in learned(exact).items():
        assert torch.equal(ahead[name], tensor), name
    assert ahead["model/growth/seen"].any() and ahead["model/growth/gradient"].any()


def test_too_small_capacity_changes_nothing(monkeypatch: pytest.MonkeyPatch):
    enough = learned(trained()[0])
    monkeypatch.setattr("padgs.methods.anchors.method.HEADROOM", 0.5)
    trainer, waited = trained()
    assert any(waited[2:]), "it was decoded once more"
    for name, tensor in learned(trainer).items():
        assert torch.equal(enough[name], tensor), name


@pytest.mark.parametrize("kind", POSITIONAL_GRADIENTS)
def test_splat_iterations_do_not_wait(kind: str):
    work = build(SIZE)
    with torch.no_grad():
        seen = work.model.decode(work.view).gaussians
    splats = Splats(seen.means, seen.scales.log(), seen.colors, degree=3)
    splats.active_degree = 3
    options, config = SplatOptions(positional_gradient=kind), RenderConfig("ray", backend="cuda")
    with pretended_gpu() as waits, call_hook(stage_of(called := [])):
        model = SplatModel(splats.to(GPU), options, config, extent=1.0, iterations=30_000)
        scene, train = resident(work.scene, GPU), TrainOptions(random_background=True)
        trainer = Trainer(model, scene, Budget(30_000), train)
        waited = steps_of(trainer, waits)
    assert waited[0] and waited[2:] == [Counter()] * (STEPS - 2), waited  # the first counts instances
    assert called.count("padgs_cuda_splats") == 2 * STEPS and model.densifier.statistics["gradient"].held.any()
