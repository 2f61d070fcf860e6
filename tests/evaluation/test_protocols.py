from dataclasses import replace

import pytest

from padgs.evaluation.protocols import LPIPS_CHOICES, PROTOCOLS
from padgs.results import higher_is_better


def test_paper_is_the_released_evaluation():
    paper = PROTOCOLS["paper"]
    assert paper.metrics == ("psnr", "ssim") and paper.lpips_name == "lpips_vgg_01"
    assert paper.bottom_crop == 0 and not paper.solid_angle and paper.rows(1000) == 1000
    # 360Roam ends at row 959 of 1024. Scaled down, a row counts only if all of it is above: 512 x 959 / 1024 = 479.5.
    cropped = replace(PROTOCOLS["paper"], bottom_crop=65 / 1024)
    assert [cropped.rows(height) for height in (1024, 512, 256, 2048)] == [959, 479, 239, 1918]


@pytest.mark.parametrize("height", [100, 1000, 1024, 1520])
@pytest.mark.parametrize("rows", [1, 37, 99])
def test_a_crop_given_as_a_share_of_the_rows_hits_the_row(height, rows):
    assert replace(PROTOCOLS["paper"], bottom_crop=rows / height).rows(height) == height - rows  # whatever rounding


@pytest.mark.parametrize("name", PROTOCOLS)
@pytest.mark.parametrize("lpips", LPIPS_CHOICES)
@pytest.mark.parametrize("inputs", ["11", "01"])
def test_every_metric_of_a_protocol_but_the_seam_has_a_direction(name, lpips, inputs):
    protocol = replace(PROTOCOLS[name], lpips=lpips, lpips_inputs=inputs)
    names = [*protocol.metrics, *([protocol.lpips_name] if lpips != "none" else [])]
    assert all(higher_is_better(name) is not None for name in names if name != "seam")
    assert (protocol.lpips_name is None) == (lpips == "none")


def test_lpips_names_are_unique():
    variants = [
        replace(PROTOCOLS[name], lpips=net, lpips_inputs=inputs).lpips_name
        for name in ("paper", "sphere")  # the others have none
        for net in ("alex", "vgg")
        for inputs in ("11", "01")
    ]
    assert len(set(variants)) == len(variants)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("paper", {"lpips": "squeeze"}, "unknown lpips 'squeeze'; known: alex, vgg, none"),
        ("paper", {"lpips_inputs": "0-1"}, "unknown lpips_inputs '0-1'; known: 11, 01"),
        ("paper", {"metrics": ("psnr", "mse")}, "unknown metric 'mse'; known: psnr, ssim"),
        ("paper", {"bottom_crop": 1.0}, "bottom_crop is 1.0"),
        ("paper", {"bottom_crop": -0.1}, "bottom_crop is -0.1"),
    ],
)
def test_bad_options_are_named(name, options, message):
    with pytest.raises(ValueError, match=message):
        replace(PROTOCOLS[name], **options)
