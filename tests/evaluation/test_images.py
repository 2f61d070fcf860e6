import numpy as np
import torch

from padgs.evaluation.images import ERROR_FULL_SCALE, comparison_image, error_image, to_uint8


def test_to_uint8_clamps_and_rounds():
    image = torch.tensor([-0.5, 0.0, 0.4 / 255, 0.6 / 255, 1.0, 7.0]).reshape(1, 2, 3)
    assert to_uint8(image).flatten().tolist() == [0, 0, 0, 1, 255, 255]
    levels = torch.arange(255).reshape(1, 85, 3)
    assert np.array_equal(to_uint8(levels / 255), levels.numpy())  # what a file holds comes back


def test_comparison_image(generator):
    truth, image = torch.rand(2, 4, 8, 3, generator=generator)
    picture = comparison_image(truth, image.requires_grad_())
    assert picture.shape == (4, 24, 3) and picture.dtype == np.uint8
    assert np.array_equal(picture[:, :8], to_uint8(truth))
    assert np.array_equal(picture[:, 8:16], to_uint8(image))
    assert np.array_equal(picture[:, 16:], error_image(image, truth))


def test_error_image_brightness_grows_with_the_error():
    truth = torch.zeros(1, 6, 3)
    errors = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0, 4.0]) * ERROR_FULL_SCALE
    image = truth + errors[None, :, None]
    brightness = error_image(image, truth)[0].astype(int).sum(-1)
    assert brightness[0] < 10  # no error is black
    assert (np.diff(brightness[:5]) > 50).all()
    assert brightness[5] == brightness[4]
    assert np.array_equal(error_image(truth, image), error_image(image, truth))
