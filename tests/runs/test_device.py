import pytest
import torch

from padgs.native import cuda
from padgs.render.config import RenderConfig
from padgs.runs.config import RunOptions
from padgs.runs.device import chosen

GPU = torch.device("cuda", 0)


@pytest.fixture
def with_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(cuda, "available", lambda: True)


def test_without_a_gpu_auto_is_the_cpu_and_cuda_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert chosen("auto", RenderConfig()) == chosen("cpu", RenderConfig()) == torch.device("cpu")
    with pytest.raises(ValueError, match="run.device=cuda, but .*set run.device=cpu or auto"):
        chosen("cuda", RenderConfig())


def test_without_a_gpu_its_backend_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for device in ("auto", "cpu"):
        with pytest.raises(ValueError, match="render.backend=cuda, but .*set render.backend=auto, cpu or torch"):
            chosen(device, RenderConfig(backend="cuda"))


@pytest.mark.usefixtures("with_gpu")
def test_the_backend_of_a_gpu_is_refused_on_the_cpu_and_where_it_is_not_built(monkeypatch):
    monkeypatch.setattr(cuda, "library", lambda: None)
    assert chosen("auto", RenderConfig(backend="cuda")) == chosen("cuda", RenderConfig(backend="cuda")) == GPU
    with pytest.raises(ValueError, match="render.backend=cuda draws on a GPU only, .*set run.device=auto"):
        chosen("cpu", RenderConfig(backend="cuda"))

    def missing():
        raise OSError("libpadgs_cuda.so not found")

    monkeypatch.setattr(cuda, "library", missing)
    with pytest.raises(OSError, match="libpadgs_cuda.so not found"):
        chosen("auto", RenderConfig(backend="cuda"))


@pytest.mark.usefixtures("with_gpu")
def test_with_a_gpu_auto_is_the_gpu_where_that_can_draw():
    assert chosen("auto", RenderConfig()) == chosen("cuda", RenderConfig()) == GPU
    assert chosen("auto", RenderConfig(projection="ray", blending="hybrid")) == GPU
    assert chosen("cpu", RenderConfig()).type == "cpu"
    for elsewhere in (RenderConfig(backend="cpu"), RenderConfig(backend="torch")):
        assert chosen("auto", elsewhere).type == "cpu"
        assert chosen("cuda", elsewhere) == GPU


@pytest.mark.usefixtures("with_gpu")
def test_without_the_library_auto_is_the_cpu(monkeypatch):
    monkeypatch.setattr(cuda, "available", lambda: False)
    assert chosen("auto", RenderConfig()).type == "cpu"


def test_an_unknown_device_is_refused():
    with pytest.raises(ValueError, match="unknown run.device 'gpu'; known: auto, cpu, cuda"):
        RunOptions(device="gpu")
