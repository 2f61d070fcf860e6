import numpy as np
import pytest
from PIL import Image

from padgs.data.store import area_resize


def test_an_output_pixel_is_the_mean_of_what_it_covers() -> None:
    image = np.array([[[0], [100], [200]]], np.uint8)
    # Each of two pixels covers 1.5 input pixels: (0 + 100 / 2) / 1.5 and (100 / 2 + 200) / 1.5.
    assert area_resize(image, 2, 1)[0, :, 0].tolist() == [33, 167]


@pytest.mark.parametrize(("width", "height"), [(61, 31), (96, 48), (2, 1), (1, 1), (192, 96)])
def test_against_the_integral_image(width: int, height: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (96, 192, 3), dtype=np.uint8)
    whole = np.zeros((97, 193, 3))
    whole[1:, 1:] = image.astype(float).cumsum(0).cumsum(1)
    rows, columns = np.linspace(0, 96, height + 1), np.linspace(0, 192, width + 1)
    top, left = np.floor(rows).astype(int).clip(0, 95), np.floor(columns).astype(int).clip(0, 191)
    s, t = (rows - top)[:, None, None], (columns - left)[None, :, None]
    at = (
        whole[top][:, left] * (1 - s) * (1 - t)
        + whole[top + 1][:, left] * s * (1 - t)
        + whole[top][:, left + 1] * (1 - s) * t
        + whole[top + 1][:, left + 1] * s * t
    )
    expected = (at[1:, 1:] - at[:-1, 1:] - at[1:, :-1] + at[:-1, :-1]) / (96 * 192 / width / height)
    assert np.abs(area_resize(image, width, height) - expected).max() <= 0.5 + 1e-3


def test_whole_ratios_agree_with_pillow() -> None:
    image = np.random.default_rng(1).integers(0, 256, (64, 128, 3), dtype=np.uint8)
    ours = area_resize(image, 32, 16).astype(int)
    assert np.abs(ours - np.asarray(Image.fromarray(image).reduce(4)).astype(int)).max() <= 1


def test_it_does_not_enlarge() -> None:
    with pytest.raises(ValueError, match="4x2 to 8x4: that is larger"):
        area_resize(np.zeros((2, 4, 3), np.uint8), 8, 4)
