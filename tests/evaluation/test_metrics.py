import json
import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from padgs.evaluation.metrics import (
    BANDS,
    METRICS,
    band_rows,
    band_ws_psnr,
    mean_color,
    psnr,
    seam,
    sphere_weight,
    ssim,
    ws_psnr,
    ws_psnr_fitted,
    ws_ssim,
)
from padgs.geometry.distortion import solid_angle_weight
from padgs.geometry.panorama import pad_panorama
from padgs.results import higher_is_better

H, W = 32, 64


@pytest.fixture
def pair(generator):
    """A smooth random panorama and a noisy render of it, float64."""
    target = torch.rand(H, W, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(H, W, 3, generator=generator, dtype=torch.float64)
    return target + 0.1 * noise, target


def ones() -> torch.Tensor:
    return torch.ones(H, W, dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", ["a", "b"])
def test_golden_values(shared, case, dtype):
    data = np.load(shared / "golden" / f"metrics_{case}.npz")
    expected = json.loads(str(data["meta"]))
    image, target = (torch.from_numpy(data[key]).to(dtype) for key in ("image", "target"))
    for metric, tolerance in (("psnr", 1e-4), ("ws_psnr", 1e-4), ("ssim", 1e-5)):
        assert METRICS[metric](image, target, None).item() == pytest.approx(expected[metric], abs=tolerance)


def test_a_constant_error_has_a_known_psnr_everywhere():
    image, target = torch.full((H, W, 3), 0.6), torch.full((H, W, 3), 0.5)
    for name, metric in METRICS.items():
        if "psnr" in name:
            assert metric(image, target, None).item() == pytest.approx(20.0, abs=1e-4), name  # -10 log10(0.1^2)


@pytest.mark.parametrize("width", [2, 8])
def test_the_smallest_panoramas_have_a_ws_ssim(width):
    image = torch.rand(width // 2, width, 3)
    assert ws_ssim(image, image).item() == pytest.approx(1)


def test_constant_images_have_a_known_ssim():
    # No variance: the contrast term is 1 and luminance is (2 a b + C1) / (a^2 + b^2 + C1). True at every pixel of the
    # panorama only because windows continue across seam and poles.
    a, b, c1 = 0.6, 0.3, 0.01**2
    image, target = torch.tensor((a, b), dtype=torch.float64)[:, None, None, None].expand(2, H, W, 3)
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert ws_ssim(image, target).item() == pytest.approx(expected, abs=1e-12)
    assert abs(ssim(image, target).item() - expected) > 1e-3  # the flat one sees black outside


def test_an_error_in_one_row_counts_by_its_solid_angle():
    weight = solid_angle_weight(H, dtype=torch.float64)
    for row in (0, 5, H // 2):
        image = torch.zeros(H, W, 3, dtype=torch.float64)
        image[row] = 0.5
        share = (weight[row] / weight.sum()).item()
        assert ws_psnr(image, torch.zeros_like(image)).item() == pytest.approx(-10 * math.log10(0.25 * share))
        assert psnr(image, torch.zeros_like(image)).item() == pytest.approx(-10 * math.log10(0.25 / H))


def test_ssim_windows_agree_with_scikit_image(pair):
    # scikit-image mirrors at the border, we do not: compare where the window lies inside, and give it the panorama
    # already continued to check the windows across seam and poles.
    options = dict(
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2, full=True
    )
    image, target = (pad_panorama(tensor, 5).numpy() for tensor in pair)
    theirs = torch.from_numpy(structural_similarity(image, target, **options)[1])[5:-5, 5:-5].mean(-1)
    weight = solid_angle_weight(H, dtype=torch.float64)[:, None]
    assert ws_ssim(*pair).item() == pytest.approx(((theirs * weight).sum() / (weight.sum() * W)).item(), abs=1e-9)
    inside = torch.zeros(H, W, dtype=torch.float64)
    inside[5:-5, 5:-5] = 1
    # Masking the outer 0 pixels leaves windows that are whole only 5 further in.
    assert ssim(*pair, inside).item() == pytest.approx(theirs[10:-10, 10:-10].mean().item(), abs=1e-9)


@pytest.mark.parametrize("shift", [1, 13, W // 2])
def test_panoramic_metrics_do_not_depend_on_yaw(pair, shift):
    mask = ones()
    mask[20:26, 3:30] = 0
    turned = [tensor.roll(shift, dims=1) for tensor in (*pair, mask)]
    for name in ("ws_psnr", "ws_ssim", *(f"ws_psnr_{band}" for band in BANDS)):
        assert METRICS[name](*turned).item() == pytest.approx(METRICS[name](*pair, mask).item(), abs=1e-10), name
    assert ssim(*turned).item() != pytest.approx(ssim(*pair, mask).item(), abs=1e-6)  # flat windows


def test_color_fit_removes_only_exposure_and_white_balance(pair, generator):
    image, target = pair
    gain, offset = torch.tensor([0.5, 1.2, 2.0]), torch.tensor([0.1, 0.0, -0.2])
    assert ws_psnr_fitted(target * gain + offset, target) > 100 > ws_psnr(target * gain + offset, target)
    fitted = ws_psnr_fitted(image, target)
    assert fitted > ws_psnr(image, target)
    torch.testing.assert_close(ws_psnr_fitted(image * gain + offset, target), fitted)
    weight = solid_angle_weight(H, dtype=torch.float64)[:, None].expand(H, W).reshape(-1).numpy()
    errors = []
    for seen, true in zip(image.reshape(-1, 3).T.numpy(), target.reshape(-1, 3).T.numpy(), strict=True):
        line = np.polynomial.Polynomial.fit(seen, true, 1, w=np.sqrt(weight))
        errors.append(np.average((line(seen) - true) ** 2, weights=weight))
    assert fitted.item() == pytest.approx(-10 * math.log10(np.mean(errors)))
    flat = torch.full_like(target, 0.3)
    torch.testing.assert_close(ws_psnr_fitted(flat, target), mean_color(target, sphere_weight(target)))
    hidden = ones()
    hidden[:, ::2] = 0
    spoilt = torch.where(hidden[..., None] > 0, image, torch.rand(H, W, 3, generator=generator, dtype=torch.float64))
    torch.testing.assert_close(ws_psnr_fitted(spoilt, target, hidden), ws_psnr_fitted(image, target, hidden))


def test_bands_partition_the_sphere():
    height = 1080  # so that bands end between rows
    area = solid_angle_weight(height, dtype=torch.float64)
    shares = {band: (area[band_rows(height, band)].sum() / area.sum()).item() for band in BANDS}
    sines = {"equator": 0.5, "middle": 3**0.5 / 2 - 0.5, "high": math.sin(math.radians(75)) - 3**0.5 / 2}
    for band, share in sines.items():  # a band between two latitudes covers the difference of their sines
        assert shares[band] == pytest.approx(share, abs=1e-6)
    assert shares["pole"] == pytest.approx(1 - math.sin(math.radians(75)), abs=1e-6)
    assert shares["zenith"] == pytest.approx(shares["nadir"]) == pytest.approx(shares["pole"] / 2)
    covered = torch.stack([band_rows(height, band).int() for band in ("equator", "middle", "high", "pole")]).sum(0)
    assert (covered == 1).all()
    assert band_rows(height, "zenith")[0] and band_rows(height, "nadir")[-1]  # down is positive


def test_a_band_sees_only_its_rows(pair):
    image, target = pair
    for band in BANDS:
        changed = target.clone()
        changed[~band_rows(H, band)] += 0.5
        assert band_ws_psnr(changed, target, band=band).item() == math.inf


@pytest.mark.parametrize("name", [*METRICS, "ws_psnr_fitted"])
def test_masked_pixels_change_nothing(pair, generator, name):
    image, target = pair
    mask = ones()
    mask[-9:, :40] = 0
    mask[0, 60:] = 0
    metric = METRICS.get(name, ws_psnr_fitted)
    masked = metric(image, target, mask).item()
    for other in (torch.rand(H, W, 3, generator=generator).double(), torch.full_like(image, math.nan)):
        ruined = torch.where(mask[..., None] > 0, image, other)
        assert metric(ruined, target, mask).item() == pytest.approx(masked, abs=1e-12)
    assert metric(image, target, ones()).item() == pytest.approx(metric(image, target, None).item(), abs=1e-12)
    assert metric(image, target, 0.5 * mask).item() == pytest.approx(masked, abs=1e-12)  # only ratios of weights count
    assert math.isnan(metric(image, target, 0 * mask).item())


def test_seam_is_one_without_a_seam_and_grows_with_a_step(generator):
    target = torch.rand(H, W, 3, generator=generator).double()
    image = target + 0.1 * torch.rand(H, W, 3, generator=generator).double()
    assert seam(image, target).item() == pytest.approx(1.0, abs=0.15)  # the same noise everywhere
    ramp = torch.linspace(0, 1, W, dtype=torch.float64)[None, :, None]
    # Steps of the ramp: 1 / (W - 1) inside, 1 across the seam.
    assert seam(target + ramp, target).item() == pytest.approx(W - 1)
    assert seam((target + ramp).roll(9, dims=1), target.roll(9, dims=1)).item() < 1  # the same step, not at the seam
    assert math.isnan(seam(target, target).item())


def test_higher_is_better_except_seam():
    assert all(higher_is_better(name) for name in METRICS if name != "seam")
