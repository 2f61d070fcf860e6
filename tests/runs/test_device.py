import pytest
import torch
from support.composed import composed
from support.tiny_scene import tiny_scene

from padgs.native import cuda
from padgs.render import RenderConfig
from padgs.runs import run as pipeline
from padgs.runs.config import RunOptions, choose_device
from padgs.runs.run import load_scene

GPU = torch.device("cuda", 0)


@pytest.fixture
def with_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(cuda, "require", lambda device: None)


def test_without_a_gpu_auto_is_the_cpu_and_cuda_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto", RenderConfig()) == choose_device("cpu", RenderConfig()) == torch.device("cpu")
    with pytest.raises(ValueError, match="Slurm gave this job a GPU, but torch finds none.*run.device=cpu"):
        choose_device("auto", RenderConfig(), strict=True)
    assert choose_device("cpu", RenderConfig(), strict=True).type == "cpu"
    with pytest.raises(ValueError, match="run.device=cuda, but .*set run.device=cpu or auto"):
        choose_device("cuda", RenderConfig())


def test_without_a_gpu_its_backend_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for device in ("auto", "cpu"):
        with pytest.raises(ValueError, match="render.backend=cuda, but .*set render.backend=auto, cpu or torch"):
            choose_device(device, RenderConfig(backend="cuda"))


@pytest.mark.usefixtures("with_gpu")
def test_the_backend_of_a_gpu_is_refused_on_the_cpu_and_where_it_is_not_built(monkeypatch):
    monkeypatch.setattr(cuda, "library", lambda: None)
    assert (
        choose_device("auto", RenderConfig(backend="cuda"))
        == choose_device("cuda", RenderConfig(backend="cuda"))
        == GPU
    )
    with pytest.raises(ValueError, match="render.backend=cuda renders on a GPU only, .*set run.device=auto"):
        choose_device("cpu", RenderConfig(backend="cuda"))

    def missing():
        raise OSError("libpadgs_cuda.so not found")

    monkeypatch.setattr(cuda, "library", missing)
    with pytest.raises(OSError, match="libpadgs_cuda.so not found"):
        choose_device("auto", RenderConfig(backend="cuda"))


@pytest.mark.usefixtures("with_gpu")
def test_with_a_gpu_auto_is_the_gpu_where_that_can_draw():
    assert choose_device("auto", RenderConfig()) == choose_device("cuda", RenderConfig()) == GPU
    assert choose_device("auto", RenderConfig(projection="ray", blending="hybrid")) == GPU
    assert choose_device("cpu", RenderConfig()).type == "cpu"
    for elsewhere in (RenderConfig(backend="cpu"), RenderConfig(backend="torch")):
        assert choose_device("auto", elsewhere).type == "cpu"
        assert choose_device("cuda", elsewhere) == GPU


@pytest.mark.usefixtures("with_gpu")
@pytest.mark.parametrize("error", [OSError("no libpadgs_cuda"), RuntimeError("compiled for 80 90; Tesla T4 has 75")])
def test_without_a_library_for_it_a_gpu_is_left_alone_and_that_is_said(monkeypatch, error):
    def missing(device):
        raise error

    monkeypatch.setattr(cuda, "require", missing)
    with pytest.raises(ValueError, match=f"a GPU is here, but cannot be used: {error}; or set run.device=cpu"):
        choose_device("auto", RenderConfig(), strict=True)
    with pytest.warns(UserWarning, match=f"a GPU is here, but the CPU is used: {error}"):
        assert choose_device("auto", RenderConfig()).type == "cpu"
    assert choose_device("cuda", RenderConfig()) == GPU, "by torch"


def test_an_unknown_place_is_refused():
    with pytest.raises(ValueError, match="unknown device 'gpu'; known: auto, cpu, cuda"):
        RunOptions(device="gpu")


def test_panoramas_are_kept_where_the_run_trains(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))
    places = []

    def load(path, format, options):
        places.append(options.device)
        return tiny_scene()

    monkeypatch.setattr(pipeline.data, "load", load)
    load_scene(composed(), torch.device("meta"))
    assert places == ["meta"]
