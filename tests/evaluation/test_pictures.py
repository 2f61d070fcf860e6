import numpy as np
import torch

from padgs.evaluation.pictures import ERROR_FULL_SCALE, comparison, eight_bit, error_picture


def test_eight_bit_clamps_and_rounds():
    image = torch.tensor([-0.5, 0.0, 0.4 / 255, 0.6 / 255, 1.0, 7.0]).reshape(1, 2, 3)
    assert eight_bit(image).flatten().tolist() == [0, 0, 0, 1, 255, 255]
    levels = torch.arange(255).reshape(1, 85, 3)
    assert np.array_equal(eight_bit(levels / 255), levels.numpy())  # what a file holds comes back


def test_three_pictures_side_by_side(generator):
    truth, image = torch.rand(2, 4, 8, 3, generator=generator)
    picture = comparison(truth, image.requires_grad_())
    assert picture.shape == (4, 24, 3) and picture.dtype == np.uint8
    assert np.array_equal(picture[:, :8], eight_bit(truth))
    assert np.array_equal(picture[:, 8:16], eight_bit(image))
    assert np.array_equal(picture[:, 16:], error_picture(image, truth))


def test_brightness_of_the_error_grows_on_one_scale():
    truth = torch.zeros(1, 6, 3)
    errors = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0, 4.0]) * ERROR_FULL_SCALE
    image = truth + errors[None, :, None]
    brightness = error_picture(image, truth)[0].astype(int).sum(-1)
    assert brightness[0] < 10  # no error is black
    assert (np.diff(brightness[:5]) > 50).all()
    assert brightness[5] == brightness[4]
    assert np.array_equal(error_picture(truth, image), error_picture(image, truth))
