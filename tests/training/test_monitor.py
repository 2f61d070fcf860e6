import json
from functools import partial

import pytest
import torch
from support.tiny_scene import tiny_scene

from padgs.gaussians import Gaussians
from padgs.methods.splats.method import SplatMethod
from padgs.render import Rendering
from padgs.results import STATUSES
from padgs.training.health import Failure, Monitor
from padgs.training.loop import Budget
from padgs.training.model import TrainingRender
from padgs.training.options import TrainOptions
from padgs.training.targets import Target

ITERATIONS = 1000


def monitor() -> Monitor:
    return Monitor(ITERATIONS, count=1000, pixels=2000)


def ends(see, expected: str) -> tuple[Failure, int]:
    """What `see(iteration)` ends in, and when."""
    for iteration in range(1, ITERATIONS + 1):
        try:
            see(iteration)
        except Failure as failure:
            assert failure.status == expected in STATUSES and "train.monitor=false" in str(failure)
            return failure, iteration
    raise AssertionError("nothing was seen")


def losses(of):
    watch = monitor()
    return lambda iteration: watch.loss(of(iteration), iteration)


def drawing(image: torch.Tensor, *, transmittance: float = 0.2) -> TrainingRender:
    three, one = torch.ones(1, 3), torch.ones(1)
    flat = torch.full(image.shape[:2], transmittance)
    gaussians = Gaussians(three, torch.ones(1, 4), three, one, three)
    return TrainingRender(Rendering(image, flat, flat, one > 0), three, gaussians, torch.arange(1))


def test_a_loss_that_rises_and_stays_has_diverged():
    failure, when = ends(losses(lambda i: 0.1 if i < 400 else 0.3), "diverged")
    assert 500 <= when <= 520
    assert "the loss at iteration" in str(failure) and "the best, 0.1 " in str(failure)


def test_losses_of_views_of_another_size_are_not_compared():
    watch = monitor()
    for iteration in range(1, 401):
        watch.begin(iteration, 1 if iteration < 200 else 0, iteration)
        watch.loss(0.1 if iteration < 200 else 0.3, iteration)
    with pytest.raises(Failure, match="the best, 0.3 "):
        for iteration in range(401, ITERATIONS):
            watch.begin(iteration, 0, iteration)
            watch.loss(0.6, iteration)


@pytest.mark.parametrize(
    "of",
    [
        lambda i: 0.3 * 0.995**i + 0.05,  # falls
        lambda i: 0.05 + 0.2 * 0.9 ** (i % 100),  # opacities are reset every 100 iterations
        lambda i: 0.05 + (0.0 if i < 500 else 0.2 * 0.995 ** (i - 500)),  # ... and come back slowly after one
        lambda i: 0.1 + 0.08 * (i % 3),  # views differ
        lambda i: 0.01 if i == 1 else 0.2,  # the first view is an easy one
        lambda i: 0.1 if i < 800 or i > 860 else 0.3,  # recovers
    ],
)
def test_a_loss_that_comes_back_has_not(of):
    see = losses(of)
    for iteration in range(1, ITERATIONS + 1):
        see(iteration)


def test_a_short_run_that_ends_while_its_loss_is_high_has_diverged():
    watch = Monitor(60, count=1000, pixels=2000)
    for iteration in range(1, 60):
        watch.loss(0.2 if iteration < 20 else 0.6, iteration)
    with pytest.raises(Failure, match="the loss at iteration 60 is .* since iteration 2"):
        watch.loss(0.6, 60)
    calm = Monitor(60, count=1000, pixels=2000)
    for iteration in range(1, 61):
        calm.loss(0.2 if iteration != 58 else 0.9, iteration)


@pytest.mark.parametrize("every", [1, 10])
def test_a_short_run_that_recovers_from_late_pruning_has_not(every: int):
    watch = Monitor(300, count=1000, pixels=2000)
    for iteration in range(every, 301, every):
        watch.loss(0.0145 if iteration < 200 else 0.028 + 0.08 * 0.9 ** (iteration - 200), iteration)
    assert watch.state["sum"] > 1.5 * watch.state["best"], "it has not come back to what it was"


def test_losses_may_be_seen_now_and_then():
    rarely, always = monitor(), monitor()
    for iteration in range(1, 401):
        always.loss(0.2, iteration)
        if iteration % 50 == 0:
            rarely.loss(0.2, iteration)
    assert rarely.state["sum"] == pytest.approx(always.state["sum"])
    assert rarely.state["seen"] == always.state["seen"] == 400


def test_too_many_parts_have_exploded_at_once_and_too_few_have_collapsed_after_a_while():
    watch = monitor()
    watch.counts({"gaussians": 20_000}, 1)
    with pytest.raises(Failure, match="20001 gaussians at iteration 2, more than 10 times the 2000") as caught:
        watch.counts({"gaussians": 20_001}, 2)
    assert caught.value.status == "exploded"
    failure, when = ends(lambda i: watch.counts({"gaussians": 9}, i), "collapsed")
    assert when == 101 and "9 of 1000 gaussians are left" in str(failure)


def test_pictures_of_nothing_have_collapsed():
    photograph = torch.rand(4, 8, 3, generator=torch.Generator().manual_seed(1))
    for made, said in (
        (drawing(photograph, transmittance=0.99), "the mean opacity is 0.01"),
        (drawing(torch.full((4, 8, 3), 0.4)), "of the variance of the image"),
    ):
        watch, target = monitor(), Target(photograph, torch.ones(4, 1))
        see = partial(watch.render, made, target)
        failure, _ = ends(lambda i, see=see: see(50 * i), "collapsed")
        assert said in str(failure) and "at iteration 150, and since 50" in str(failure)


def test_a_void_may_stay_empty_and_what_a_mask_hides_does_not_count():
    photograph = torch.rand(4, 8, 3, generator=torch.Generator().manual_seed(1))
    small = torch.zeros(4, 8)
    small[1, :2] = 1
    made = drawing(photograph * small[..., None], transmittance=0.5)  # of all pixels the opacity is 0.03
    made.rendering.transmittance[small == 0] = 1
    for target in (Target(photograph * small[..., None], torch.ones(4, 1)), Target(photograph, small)):
        watch = monitor()
        for iteration in range(1, ITERATIONS):
            watch.render(made, target, iteration)
    hidden = drawing(torch.where(small[..., None] > 0, 0.4, photograph))
    with pytest.raises(Failure, match="of the variance of the image"):
        for iteration in range(1, ITERATIONS):
            watch.render(hidden, target, iteration)


def test_where_the_schedule_follows_the_clock_a_sign_lasts_for_a_share_of_it():
    watch = monitor()
    for iteration in range(1, 2000):  # 2000 steps are a tenth of the schedule
        watch.begin(iteration // 20, 0, iteration)
        watch.counts({"gaussians": 9}, iteration)
    watch.begin(101, 0, 2001)
    with pytest.raises(Failure, match="few since 1"):
        watch.counts({"gaussians": 9}, 2001)


def test_what_it_remembers_is_json_and_goes_on():
    first, second = monitor(), monitor()
    for iteration in range(1, 150):
        first.loss(0.1 if iteration < 100 else 0.4, iteration)
    second.state = json.loads(json.dumps(first.state))
    assert (
        ends(lambda i: first.loss(0.4, 149 + i), "diverged")[1]
        == ends(lambda i: second.loss(0.4, 149 + i), "diverged")[1]
    )


def test_a_resumed_run_is_compared_with_the_model_that_it_began_with():
    began, resumed = Monitor(ITERATIONS, count=5000, pixels=100), Monitor(ITERATIONS, count=10, pixels=100)
    resumed.state = json.loads(json.dumps(began.state))
    resumed.counts({"gaussians": 50_000}, 1)
    with pytest.raises(Failure, match="50001 gaussians at iteration 2, more than 10 times the 5000"):
        resumed.counts({"gaussians": 50_001}, 2)


def test_a_failing_run_stops_early_unless_it_is_not_to_be_watched(monkeypatch):
    monkeypatch.setattr("padgs.training.health.FAINTEST", 2.0)  # every render is too faint
    scene, budget = tiny_scene(), Budget(160)
    with pytest.raises(Failure, match="at iteration 150, and since 50") as caught:
        list(SplatMethod(train=TrainOptions(check_every=50)).fit(scene, budget))
    assert caught.value.status == "collapsed"
    assert len(list(SplatMethod(train=TrainOptions(monitor=False)).fit(scene, budget))) == 160
