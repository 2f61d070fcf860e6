import math

import pytest
import torch

from padgs.evaluation.diagnostics import blurred, oracle, pole_gap
from padgs.evaluation.metrics import ws_psnr
from padgs.geometry.panorama import rays, row_latitudes, sample

WIDTH, HEIGHT = 192, 96


def detail(pole: float, equator: float = 0.2) -> torch.Tensor:
    """Waves in the world's three directions, of this amplitude at the poles and at the horizon."""
    waves = torch.sin(9 * rays(WIDTH, HEIGHT)).prod(-1, keepdim=True).expand(-1, -1, 3)
    share = torch.sin(row_latitudes(HEIGHT)).abs()[:, None, None]
    return 0.5 + (equator + (pole - equator) * share) * waves


def test_the_gap_is_the_difference_of_two_bands():
    target, latitudes = torch.zeros(HEIGHT, WIDTH, 3), row_latitudes(HEIGHT).rad2deg().abs()[:, None, None]
    image = torch.where(latitudes > 75, 0.1, torch.where(latitudes < 30, 0.01, 0.5)).expand_as(target)
    assert pole_gap(image, target).item() == pytest.approx(20)
    hidden = (latitudes[..., 0] < 75).float().expand(HEIGHT, WIDTH)
    assert pole_gap(image, target, hidden).isnan()


def test_a_blur_is_the_same_wherever_it_looks():
    """Of a Gaussian spot, whether it lies on the horizon, by a pole or on the seam: wider, and as bright in sum."""
    spot, sigma = 0.15, 0.1
    weight = row_latitudes(HEIGHT).cos()[:, None]
    for center in ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, -0.98, 0.2], [0.0, 0.0, -1.0]):
        at = torch.nn.functional.normalize(torch.tensor(center), dim=0)
        image = torch.exp(((rays(WIDTH, HEIGHT) * at).sum(-1, keepdim=True) - 1) / spot**2)
        wide = blurred(image, sigma)
        assert (wide[..., 0] * weight).sum() == pytest.approx((image[..., 0] * weight).sum().item(), rel=0.01)
        assert sample(wide, at).item() == pytest.approx(spot**2 / (spot**2 + sigma**2), rel=0.05)


def test_it_goes_on_beyond_the_poles():
    """Of directions themselves all that a blur changes is their length."""
    ahead = rays(WIDTH, HEIGHT)
    for sigma in (0.01, 0.1):  # the first leans on half a pixel across a pole
        assert (blurred(ahead, sigma) - ahead * math.exp(-(sigma**2))).abs().max() < 5e-4


def test_the_oracle_is_as_good_as_the_image_and_knows_where_the_detail_is():
    gaps = []
    for target in (detail(0.02), detail(0.3, 0.02)):
        image = target + 0.02 * torch.randn(target.shape, generator=torch.Generator().manual_seed(0))
        found = oracle(image, target)
        assert found is not None
        assert ws_psnr(found, target).item() == pytest.approx(ws_psnr(image, target).item(), abs=0.2)
        gaps.append(pole_gap(found, target).item())
    assert gaps[0] < -5 and gaps[1] > 3


def test_what_is_blurred_alike_everywhere_has_the_gap_of_its_oracle():
    target = detail(0.05)
    image = blurred(target, 0.03)
    found = oracle(image, target)
    assert found is not None and abs(pole_gap(image, target) - pole_gap(found, target)) < 0.2
    worse = image.clone()
    worse[row_latitudes(HEIGHT).abs() > math.radians(70)] = 0.5  # poles that were never learned
    found = oracle(worse, target)
    assert found is not None and pole_gap(worse, target) - pole_gap(found, target) > 3


@pytest.mark.parametrize("error", [0.0, 0.6])
def test_nothing_is_compared_with_what_no_blur_is(error):
    target = detail(0.2)
    assert oracle(target + error, target) is None
