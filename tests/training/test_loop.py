import math
import time
from collections import Counter
from dataclasses import replace

import pytest
import torch
from support.states import assert_same_but_time
from support.tiny_scene import tiny_scene
from torch import Tensor, nn

from padgs import clock
from padgs.gaussians import Gaussians
from padgs.methods.splats.method import SplatMethod
from padgs.render import Rendering
from padgs.scene import View
from padgs.training import schedule as schedules
from padgs.training.health import Failure
from padgs.training.loop import Trainer, background
from padgs.training.model import State, TrainingRender
from padgs.training.options import Budget, TrainOptions
from padgs.training.schedule import Constant, LogLinear, ParameterGroup


class Flat:
    """The least that can be trained: one colour for the whole image, plus noise from its own generator."""

    def __init__(self) -> None:
        self.color = nn.Parameter(torch.full((3,), 0.2))
        self.noise = torch.Generator().manual_seed(4)
        self.views: list[str] = []
        self.calls: list[str] = []
        self.statistic = torch.zeros(())
        self.drawn = 1
        self.rates = LogLinear(1e-2, 1e-3, 20)

    def groups(self) -> list[ParameterGroup]:
        return [ParameterGroup("color", (self.color,), self.rates)]

    def draw(self, view: View) -> TrainingRender:
        self.calls.append("draw")
        self.views.append(view.name)
        noise = torch.rand(view.height, view.width, 1, generator=self.noise) * torch.rand(1)
        image = (self.color + 0.01 * noise).expand(view.height, view.width, 3)
        flat = torch.zeros(view.height, view.width)
        probe = torch.zeros(self.drawn, 2, requires_grad=True)
        drawn = Gaussians(*(torch.zeros(self.drawn, *shape) for shape in ((3,), (4,), (3,), (), (3,))))
        visible = torch.ones(self.drawn, dtype=torch.bool)
        return TrainingRender(
            Rendering(image + probe.sum(), flat, flat, visible), probe, drawn, torch.arange(self.drawn)
        )

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        self.calls.append("observe")
        assert drawing.mean_offsets.grad is not None
        self.statistic = self.statistic + drawing.mean_offsets.grad.sum()

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        self.calls.append("adapt")
        return (f"reached {iteration}",) if iteration % 10 == 0 else ()

    def counts(self) -> dict[str, int]:
        return {"colors": 1}

    def state(self) -> State:
        return State(
            {"color": self.color, "statistic": self.statistic, "noise": self.noise.get_state()}, {"kind": "flat"}
        )

    def load_state(self, state: State) -> None:
        assert state.values == {"kind": "flat"}
        self.color.data = state.tensors["color"].clone()
        self.statistic = state.tensors["statistic"].clone()
        self.noise.set_state(state.tensors["noise"])


def trainer(model: Flat, iterations: int = 20, **options) -> Trainer:
    return Trainer(model, tiny_scene(), Budget(iterations), TrainOptions(**options), seed=3)


def test_every_view_has_its_turn_before_any_has_a_second():
    model = Flat()
    list(trainer(model, 20).records())
    epochs = [model.views[start : start + 5] for start in range(0, 20, 5)]
    assert all(sorted(epoch) == ["00", "01", "02", "03", "04"] for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1, "epochs are shuffled"


def test_order_depends_on_the_seed_alone():
    orders = []
    for seed in (3, 3, 4):
        model = Flat()
        torch.rand(seed)  # whatever else happened
        list(Trainer(model, tiny_scene(), Budget(15), seed=seed).records())
        orders.append(model.views)
    assert orders[0] == orders[1] != orders[2]


def test_records_count_and_tell():
    model = Flat()
    records = list(trainer(model, 20).records())
    assert [record.iteration for record in records] == list(range(1, 21))
    assert [record.events for record in records if record.events] == [("reached 10",), ("reached 20",)]
    assert records[0].counts == {"colors": 1, "drawn": 1}
    assert all(a.seconds < b.seconds for a, b in zip(records, records[1:], strict=False))
    assert records[-1].loss < records[0].loss
    assert Counter(model.calls) == {"draw": 20, "observe": 20, "adapt": 20}
    assert model.calls[:3] == ["draw", "observe", "adapt"]


def test_an_iteration_may_draw_several_views_before_adam_steps_on_the_sum_of_their_losses():
    model = Flat()
    model.draw = lambda view: plain(Flat.draw(model, view), model.color)
    scene, color = tiny_scene(), model.color.detach().clone().requires_grad_()
    run = Trainer(model, scene, Budget(2), TrainOptions(lambda_l1=1.0, weight="uniform"), seed=3, views_each=5)
    record = next(run.records())
    assert model.calls == [*["draw", "observe"] * 5, "adapt"]
    assert sorted(model.views) == [view.name for view in scene.train]
    losses = [(color - view.image()).abs().mean() for view in scene.train]
    assert record.loss == pytest.approx(sum(losses).item() / 5, rel=1e-5)
    (gradient,) = torch.autograd.grad(sum(losses), color)
    moments = run._optimizer.adam.state[model.color]
    assert torch.allclose(moments["exp_avg"], 0.1 * gradient, rtol=1e-4, atol=1e-7)


def plain(drawing: TrainingRender, color: Tensor) -> TrainingRender:
    """The same without noise."""
    image = color + 0 * drawing.rendering.image.detach() + drawing.mean_offsets.sum()
    return replace(drawing, rendering=replace(drawing.rendering, image=image))


def test_learning_rates_follow_their_schedule():
    """The first steps of Adam have the size of the learning rate, whatever the gradient."""
    for choice, factor in (("published", 1.0), ("run", 8.0), (3, 3.0)):
        model = Flat()
        records = Trainer(model, tiny_scene(), Budget(20), TrainOptions(learning_rates=choice)).records()
        before = model.color.detach().clone()
        next(records)
        step = (model.color.detach() - before).abs()
        assert torch.allclose(step, torch.full((3,), factor * model.rates(1)), rtol=1e-4)


def test_out_of_time_stops_without_an_error():
    run = Trainer(Flat(), tiny_scene(), Budget(10**9, max_seconds=0.05), seed=3)
    records = list(run.records())
    assert 1 <= len(records) < 10**5 and records[-1].seconds >= 0.05
    assert all(record.seconds < 0.05 for record in records[:-1])


@pytest.mark.parametrize("stop", [0, 1, 4, 5, 13, 19, 20])
def test_resuming_changes_nothing(stop):
    torch.manual_seed(0)
    whole = trainer(Flat())
    losses = [record.loss for record in whole.records()]
    final = whole.state()

    torch.manual_seed(0)
    first = trainer(Flat())
    records = first.records()
    before = [next(records).loss for _ in range(stop)]
    state = first.state()
    next(records, None)  # what happens after a state was taken does not change it

    torch.manual_seed(99)  # another process, other random numbers
    second = trainer(Flat())
    second.load_state(state)
    after = [record.loss for record in second.records()]
    assert before + after == losses
    assert_same_but_time(second.state(), final)
    assert second.seconds > state.values["seconds"] or stop == 20


def test_state_of_another_scene_is_refused():
    state = trainer(Flat()).state()
    scene = tiny_scene()
    other = Trainer(Flat(), replace(scene, train=scene.train[:3]), Budget(5))
    with pytest.raises(ValueError, match="a run with 5 training views, but scene 'tiny' has 3"):
        other.load_state(state)


class Poisoned(Flat):
    """Goes wrong at iteration 7, in a place of choice."""

    def __init__(self, place: str) -> None:
        super().__init__()
        self.place = place

    def draw(self, view: View) -> TrainingRender:
        drawing = super().draw(view)
        if len(self.views) != 7:
            return drawing
        image = drawing.rendering.image
        if self.place == "image":
            image = image + image.new_tensor([0.0, math.nan, 0.0])
        if self.place == "scales":
            drawing.gaussians.scales[0, 2] = math.inf
            image = image * math.nan
        if self.place == "gradient":
            image = image + SilentlyBroken.apply(self.color)
        return replace(drawing, rendering=replace(drawing.rendering, image=image))

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        if iteration == 6 and self.place == "parameter":
            self.color.data[1] = math.nan
        return super().adapt(iteration, optimizer)


class SilentlyBroken(torch.autograd.Function):
    """Zero, with an infinite derivative: the loss stays finite."""

    @staticmethod
    def forward(ctx, color: Tensor) -> Tensor:
        return torch.zeros_like(color)

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        return torch.full_like(grad, math.inf)


@pytest.mark.parametrize(
    "place, reason",
    [
        ("image", r"image\[0, 0, 1\] is nan at iteration 7"),
        ("scales", r"scales\[0, 2\] is inf at iteration 7"),
        ("parameter", r"color\[1\] is nan at iteration 7"),
        ("gradient", r"gradient of color\[0\] is inf at iteration 7"),
    ],
)
def test_non_finite_numbers_stop_the_run_and_are_named(place, reason):
    model = Poisoned(place)
    done = []
    with pytest.raises(Failure, match=reason) as caught:
        for record in trainer(model, 20, check_every=1).records():
            done.append(record.iteration)
    assert caught.value.status == "nan"
    assert done == [1, 2, 3, 4, 5, 6]


def test_poison_that_leaves_the_loss_finite_is_found_at_the_next_check():
    class Hidden(Flat):
        def groups(self) -> list[ParameterGroup]:
            self.unused = nn.Parameter(torch.zeros(4))
            return [*super().groups(), ParameterGroup("unused", (self.unused,), Constant(0.0))]

        def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
            self.unused.data[2] = math.nan  # as NaN in a Gaussian that no camera sees
            return ()

    with pytest.raises(Failure, match=r"unused\[2\] is nan at iteration 8"):
        list(trainer(Hidden(), 20, check_every=8).records())


def test_nothing_left_to_draw_is_a_collapse():
    model = Flat()
    model.drawn = 0
    with pytest.raises(Failure, match="no Gaussian is left to draw at iteration 1") as caught:
        list(trainer(model).records())
    assert caught.value.status == "collapsed"


def test_out_of_memory_is_a_status_and_other_errors_are_not():
    class Greedy(Flat):
        def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
            torch.empty(1 << 60, dtype=torch.uint8)
            return ()

    with pytest.raises(Failure, match="out of memory at iteration 1") as caught:
        list(trainer(Greedy()).records())
    assert caught.value.status == "oom"

    class Wrong(Flat):
        def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
            raise RuntimeError("a mistake in the program")

    with pytest.raises(RuntimeError, match="a mistake in the program") as caught:
        list(trainer(Wrong()).records())
    assert not isinstance(caught.value, Failure)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weight": "sphere"}, "unknown weight 'sphere'; known: solid_angle, uniform, end_rows"),
        ({"normalisation": "sum"}, "unknown normalisation 'sum'; known: mean, channel_sum"),
        ({"lambda_l1": 1.2}, r"lambda_l1 is 1\.2"),
        ({"check_every": 0}, "check_every is 0"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        TrainOptions(**options)


TICK = 1 / 128  # seconds; sums of it are exact


class Clock:
    """Time that passes only in steps of a trainer, each longer than the one before."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, first: float = TICK, growth: float = 1.0) -> None:
        self.now, self._step, self._growth = 0.0, first, growth
        for name in ("perf_counter", "process_time"):
            monkeypatch.setattr(clock.time, name, lambda: self.now)

    def tick(self) -> None:
        self.now, self._step = self.now + self._step, self._step * self._growth


class Timed(Flat):
    """Takes as long as a clock says, and notes which moments of its schedule came."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock, self.moments = clock, list[int]()

    def draw(self, view: View, probe: Tensor | None = None) -> TrainingRender:
        self.clock.tick()
        return super().draw(view)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        self.moments.append(iteration)
        return super().adapt(iteration, optimizer)


def test_time_spent_by_the_caller_does_not_count(monkeypatch):
    clock = Clock(monkeypatch)
    records = Trainer(Timed(clock), tiny_scene(), Budget(3), seed=3).records()
    next(records)
    clock.now += 1.0  # evaluation, files, ...
    second = next(records)
    assert (second.seconds, second.cpu_seconds) == (2 * TICK, 2 * TICK)


@pytest.mark.parametrize("seconds", [None, 0.5])
def test_building_the_start_is_training_time(seconds):
    class Slow(SplatMethod):
        def build_model(self, scene, iterations):
            time.sleep(0.1)
            return super().build_model(scene, iterations)

    first = next(Slow().fit(tiny_scene(), Budget(2, seconds=seconds)))
    assert first.seconds > (0.1 if seconds is None else 0.2)  # a start for the rehearsal, and one for the run


@pytest.mark.parametrize("clock", ["wall", "cpu"])
@pytest.mark.parametrize(("schedule", "growth"), [(100, 1.0), (30, 1.0), (400, 1.0), (100, 1.02), (100, 0.98)], ids=str)
def test_a_budget_of_seconds_ends_on_time_and_goes_once_through_the_whole_schedule(
    monkeypatch, schedule, growth, clock
):
    monkeypatch.setattr(schedules, "FASTEST", 1e9)
    seconds = 100 * TICK if growth == 1 else 40 * TICK
    trainee = Timed(Clock(monkeypatch, growth=growth))
    run = Trainer(trainee, tiny_scene(), Budget(schedule, seconds=seconds, clock=clock), seed=3)
    records = list(run.records())
    assert records[-1].seconds == pytest.approx(seconds, rel=0.05)
    assert trainee.moments == list(range(1, schedule + 1))
    for record in records:
        assert record.progress == pytest.approx(record.seconds / seconds, abs=0.05 + 1 / schedule)
    fitting = schedules.Pace.of("run", len(records)).factor
    assert run._optimizer.pace.factor == pytest.approx(fitting, rel=0.05), "rates fit the steps that were taken"
    assert [record.progress == 1 for record in records] == [False] * (len(records) - 1) + [True]


def test_resuming_in_a_budget_of_seconds_changes_nothing_but_what_the_clock_does(monkeypatch):
    def trainer(clock: Clock) -> Trainer:
        torch.manual_seed(0)
        return Trainer(Timed(clock), tiny_scene(), Budget(50, seconds=40 * TICK), seed=3)

    whole = trainer(Clock(monkeypatch))
    expected = list(whole.records())
    stopped = trainer(Clock(monkeypatch))
    records = stopped.records()
    first = [next(records) for _ in range(7)]
    state = stopped.state()
    resumed = trainer(Clock(monkeypatch))
    resumed.load_state(state)
    assert [*first, *resumed.records()] == expected
    assert_same_but_time(resumed.state(), whole.state())


class Transparent(Flat):
    """Draws nothing."""

    def draw(self, view: View) -> TrainingRender:
        drawn = super().draw(view)
        clear = torch.ones(view.height, view.width)
        return replace(drawn, rendering=replace(drawn.rendering, image=0 * drawn.rendering.image, transmittance=clear))


@pytest.mark.parametrize(("grey", "random_background"), [(51, False), (51, True), (0, True)])
def test_random_backgrounds_are_behind_all_but_black(grey, random_background):
    views = tuple(replace(v, load_pixels=lambda v=v: 0 * v.load_pixels() + grey) for v in tiny_scene().train)
    options = TrainOptions(lambda_l1=1.0, random_background=random_background)
    scene = replace(tiny_scene(), train=views)
    losses = [record.loss for record in Trainer(Transparent(), scene, Budget(3), options, seed=2**62).records()]
    colors = [background(i, 2**62) if random_background and grey else [0.0] * 3 for i in (1, 2, 3)]
    assert background(1, 0) != background(1, 1) != background(2, 1) and background(1, 1) == background(1, 1)
    assert losses == pytest.approx([sum(abs(value - grey / 255) for value in color) / 3 for color in colors])
