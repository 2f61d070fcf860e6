"""Promises of every method of padgs. Copy this to your tests and change NAME; `pytest` must pass."""

import pytest
import torch

import padgs
from padgs.runs import checkpoint

NAME = "my_method"
ROOM = {"train_views": 3, "test_views": 1, "samples": 1, "points": 200, "width": 32}
STEPS, STOP = 12, 7


@pytest.fixture(scope="module")
def scene():
    return padgs.load_scene(generator=ROOM)


def made():
    torch.manual_seed(0)
    return padgs.make_method(NAME)


def trained(scene):
    method = made()
    return method, list(method.fit(scene, padgs.Budget(STEPS)))


def test_it_trains_and_shows_something(scene):
    method, records = trained(scene)
    assert [record.iteration for record in records] == list(range(1, STEPS + 1))
    assert all(torch.isfinite(torch.as_tensor(record.loss)) for record in records)
    for view in (scene.train[0], scene.test[0]):
        image = method.render(view).image
        assert image.shape == (view.height, view.width, 3) and not image.requires_grad
        assert torch.isfinite(image).all() and image.std() > 0.01
    assert method.size().parameters > 0 and method.size().bytes > 0


def test_the_same_seed_gives_the_same_images(scene):
    first, second = (trained(scene)[0].render(scene.test[0]).image for _ in range(2))
    assert torch.equal(first, second)


def test_stopped_and_resumed_it_ends_as_if_nothing_had_happened(scene, tmp_path):
    whole, _ = trained(scene)
    first = made()
    records = first.fit(scene, padgs.Budget(STEPS))
    for _ in range(STOP):
        next(records)
    checkpoint.save(first.state(), tmp_path)
    torch.manual_seed(1)  # another process
    second = made()
    second.load_state(checkpoint.load(tmp_path))
    assert [record.iteration for record in second.fit(scene, padgs.Budget(STEPS))] == list(range(STOP + 1, STEPS + 1))
    assert torch.equal(second.render(scene.test[0]).image, whole.render(scene.test[0]).image)


def test_it_draws_nothing_before_it_has_learned(scene):
    with pytest.raises(RuntimeError, match="call fit or load_state first"):
        made().render(scene.test[0])
    with pytest.raises(ValueError, match="must be > 0"):
        padgs.make_method(NAME, "method.rate=0")  # your own rules, if you have any
