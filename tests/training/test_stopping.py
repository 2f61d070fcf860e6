"""Runs that stop by themselves or are stopped: they fade, train on all views again, and resume to the same."""

import pytest
import torch
from support.states import assert_same_but_time
from support.tiny_scene import HEIGHT, WIDTH, tiny_scene
from torch import Tensor

from padgs.baselines import METHODS
from padgs.checks import lookup
from padgs.methods.splats.method import SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig, Rendering
from padgs.scene import View
from padgs.training.health import FADE, EarlyStopping, Failure, quality, validation_split
from padgs.training.loop import Trainer
from padgs.training.options import Budget
from padgs.training.targets import TrainingViews

ITERATIONS = 100


class Counted(SplatModel):
    """Notes the views that are drawn, and which schedule steps come."""

    def __init__(self, scene) -> None:
        splats = Splats.from_scene(scene, degree=0, generator=torch.Generator().manual_seed(0))
        super().__init__(splats, SplatOptions(), RenderConfig(), extent=1.0, iterations=ITERATIONS)
        self.drawn, self.steps = [], []

    def draw(self, view: View, probe: Tensor | None = None):
        self.drawn.append(view.name)
        return super().draw(view, probe)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        self.steps.append(iteration)
        return super().adapt(iteration, optimizer)


def views_of(count: int) -> list[View]:
    return [View(str(number), torch.eye(4, dtype=torch.float64), WIDTH, HEIGHT) for number in range(count)]


@pytest.fixture
def scene():
    tiny = tiny_scene()
    return type(tiny)(**{**vars(tiny), "train": (*tiny.train, *tiny.test)})


def trainer(scene, stop: str = "auto") -> Trainer:
    torch.manual_seed(0)
    return Trainer(Counted(scene), scene, Budget(ITERATIONS, stop=stop), seed=1)


def stopping() -> EarlyStopping:
    return EarlyStopping(views_of(6), Budget(ITERATIONS, stop="auto"))


def test_a_plateau_is_where_the_average_gains_nothing_and_not_before():
    rising, flat = stopping(), stopping()
    assert not any(rising._is_settled(20 + 0.1 * step, 1, step) for step in range(1, 101))
    values = [20 + min(step, 40) for step in range(1, 101)]
    first = next(step for step, value in enumerate(values, 1) if flat._is_settled(value, 1, step))
    assert 45 < first < 75 and flat.state["next"] == first + 1
    for counts in (range(1, 101), range(100, 0, -1), [100] * 97 + [50] * 3):  # growth, pruning, pruned just now
        changing = stopping()
        values = enumerate(counts)
        assert not any(changing._is_settled(20.0 + 0.1 * step * (step < 97), count, step) for step, count in values)


def test_validation_views_are_trained_on_during_the_fade(scene, monkeypatch):
    monkeypatch.setattr(EarlyStopping, "_is_settled", lambda self, psnr, count, step: step > 49)
    run = trainer(scene)
    apart = {scene.train[number].name for number in validation_split(scene.train)}
    records = list(run.records())
    model = run._model
    stopped = next(number for number, record in enumerate(records) if any("stopping" in e for e in record.events))
    assert stopped == 49
    assert apart.isdisjoint(model.drawn[: stopped + 1]) and apart < set(model.drawn[stopped + 1 :])
    assert model.steps == [*range(1, 51), *range(round((1 - FADE) * ITERATIONS) + 1, ITERATIONS + 1)]
    assert records[-1].progress == 1 and len(records) == 65 and run.skipped == 35 and "0.02 dB" in run.ended


@pytest.mark.parametrize("seed", range(3))
def test_they_come_back_within_the_epoch_that_runs(scene, seed):
    apart = validation_split(scene.train)
    order = TrainingViews(scene, seed=seed, held_out=apart)
    drawn = [order.next(1.0)[0]]
    order.include_held_out()
    drawn += [order.next(1.0)[0] for _ in range(2)]
    order.include_held_out()
    drawn += [order.next(1.0)[0] for _ in range(3)]
    assert drawn[0] not in apart and sorted(drawn) == list(range(6))


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_the_shortest_runs_end_well_when_they_are_stopped(scene, iterations):
    run, progress = Trainer(Counted(scene), scene, Budget(iterations), seed=1), 0.0
    for record in run.records():
        run.request_stop("asked")
        progress = record.progress
    assert progress == 1


def test_rates_never_rise_when_a_run_is_stopped(scene):
    run = trainer(scene, "end")
    rates = []
    for record in run.records():
        rates.append([group["lr"] for group in run._optimizer.adam.param_groups])
        if record.iteration == 70:
            assert run.request_stop("asked")
    assert not run.request_stop("asked again"), "it is over"
    for before, now in zip(rates[:-1], rates[1:], strict=True):
        assert all(rate <= last for rate, last in zip(now, before, strict=True))


@pytest.mark.parametrize("at", [30, 50, 60])
def test_a_stopped_run_resumes_to_the_same(scene, monkeypatch, at):
    monkeypatch.setattr(EarlyStopping, "_is_settled", lambda self, psnr, count, step: step > 49)
    whole = trainer(scene)
    expected = [record.loss for record in whole.records()]
    first = trainer(scene)
    losses = [record.loss for _, record in zip(range(at), first.records(), strict=False)]
    again = trainer(scene)
    again.load_state(first.state())
    losses += [record.loss for record in again.records()]
    assert losses == expected
    assert_same_but_time(again.state(), whole.state())


def test_in_a_budget_of_seconds_the_fade_takes_its_share_of_them():
    budget = Budget(100, seconds=10.0)
    assert budget.next_step(85, spent=3.0, step_seconds=0.1, skipped=55) == 86
    assert budget.next_step(99, spent=4.45, step_seconds=0.1, skipped=55) == 100


def test_quality_is_the_mean_ws_psnr():
    from padgs.evaluation.metrics import ws_psnr

    views = tiny_scene().train[:2]
    images = {view.name: view.image() * 0.9 + 0.05 for view in views}
    nothing = torch.zeros(HEIGHT, WIDTH)
    found = quality(lambda view: Rendering(images[view.name], nothing, nothing, nothing[0] > 0), views)
    assert found == pytest.approx(sum(ws_psnr(images[v.name], v.image()).item() for v in views) / 2, abs=1e-4)


def test_a_longer_budget_than_that_of_the_state_is_followed(scene):
    longer = Trainer(Counted(scene), scene, Budget(2 * ITERATIONS), seed=1)
    longer.load_state(trainer(scene, stop="end").state())
    assert longer.schedule == 2 * ITERATIONS


def test_too_few_views_for_a_validation_split_are_refused():
    with pytest.raises(ValueError, match="5 training views leave no validation views.*it takes 6"):
        Trainer(Counted(tiny_scene()), tiny_scene(), Budget(10, stop="auto"))
    with pytest.raises(ValueError, match="unknown stop 'never'; known: end, auto"):
        Budget(10, stop="never")


def test_a_render_that_is_not_a_number_ends_the_run(scene):
    gray, nothing = torch.full((HEIGHT, WIDTH, 3), torch.nan), torch.zeros(HEIGHT, WIDTH)
    with pytest.raises(Failure, match="the render of validation view 00 is not finite"):
        quality(lambda view: Rendering(gray, nothing, nothing, nothing[0] > 0), tiny_scene().train[:1])


@pytest.mark.parametrize("name", ["egonerf", "sc_omnigs", "crops_3dgs"])
def test_methods_without_validation_views_refuse_early_stopping(name, scene):
    with pytest.raises(ValueError, match="budget.stop is auto.*set it to end"):
        lookup(METHODS, name, "method")().fit(scene, Budget(10, stop="auto"))
