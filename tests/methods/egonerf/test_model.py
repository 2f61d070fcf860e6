"""Training on random rays."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from support.tiny_scene import tiny_scene
from torch import Tensor, nn

from padgs.methods.egonerf.model import RayTrainer
from padgs.scene import Scene
from padgs.training.health import Failure
from padgs.training.model import State
from padgs.training.options import Budget, TrainOptions
from padgs.training.schedule import Constant, ParameterGroup


class Flat:
    """The least that rays can be traced through: one colour, whatever the ray."""

    def __init__(self, rays_at_once: int = 1000, penalty: float = 0.0) -> None:
        self.color = nn.Parameter(torch.full((3,), 0.2))
        self.field = SimpleNamespace(options=SimpleNamespace(rays_at_once=rays_at_once))
        self.penalty = penalty
        self.passes: list[int] = []

    def groups(self) -> list[ParameterGroup]:
        return [ParameterGroup("color", (self.color,), Constant(1e-2))]

    def colors(self, origins: Tensor, directions: Tensor, generator: torch.Generator) -> Tensor:
        self.passes.append(len(origins))
        return self.color.expand(len(origins), 3)

    def regularisation(self, iteration: int) -> Tensor | None:
        return self.penalty * self.color.sum() if self.penalty else None

    def counts(self) -> dict[str, int]:
        return {"colors": 1}

    def summary(self) -> str:
        return "flat"

    def state(self) -> State:
        return State({"color": self.color}, {})

    def load_state(self, state: State) -> None:
        self.color.data = state.tensors["color"].clone()


def trainer(model: Flat, iterations: int = 400, weight: str = "uniform", scene: Scene | None = None) -> RayTrainer:
    options = TrainOptions(weight=weight, learning_rates="published")
    return RayTrainer(model, scene or tiny_scene(), Budget(iterations), options, seed=3, rays=200)


def test_the_mean_colour_is_learned():
    model = Flat()
    records = list(trainer(model).records())
    mean = torch.stack([view.image() for view in tiny_scene().train]).mean((0, 1, 2))
    assert torch.allclose(model.color.detach(), mean, atol=0.03)
    assert records[-1].loss < records[0].loss and records[0].counts == {"colors": 1, "rays": 200}


def test_loss_is_the_weighted_squared_error():
    model = Flat()
    run = trainer(model, weight="solid_angle")
    rays = trainer(model, weight="solid_angle")._pixels.draw(200)
    error = ((0.2 - rays.color).square().mean(-1) * rays.weight).sum() / rays.weight.sum()
    assert next(run.records()).loss == pytest.approx(error.item(), rel=1e-5)


def test_passes_sum_to_the_same_step():
    whole, parts = Flat(), Flat(rays_at_once=64)
    losses = [[record.loss for record in trainer(model, 5).records()] for model in (whole, parts)]
    assert parts.passes[:4] == [64, 64, 64, 8] and whole.passes[0] == 200
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    assert torch.allclose(whole.color, parts.color, atol=1e-5)


def test_regularisation_is_trained_but_not_recorded():
    plain, penalised = Flat(), Flat(penalty=-100.0)
    first = [next(trainer(model).records()).loss for model in (plain, penalised)]
    assert first[0] == first[1]
    assert plain.color[0] < 0.2 < penalised.color[0]


@pytest.mark.parametrize("stop", [0, 1, 13, 20])
def test_resuming_changes_nothing(stop):
    whole = trainer(Flat(), 20)
    losses = [record.loss for record in whole.records()]
    first = trainer(Flat(), 20)
    records = first.records()
    before = [next(records).loss for _ in range(stop)]
    state = first.state()
    next(records, None)
    second = trainer(Flat(), 20)
    second.load_state(state)
    assert before + [record.loss for record in second.records()] == losses
    for name, tensor in whole.state().tensors.items():
        assert name == "random/torch" or torch.equal(tensor, second.state().tensors[name]), name


def test_state_of_other_data_is_refused():
    state = trainer(Flat(), 5).state()
    other = trainer(Flat(), 5, scene=replace(tiny_scene(), train=tiny_scene().train[:2]))
    with pytest.raises(ValueError, match="a run on 2560 pixels, but the training views have 1024"):
        other.load_state(state)


def test_non_finite_colours_are_reported():
    broken = Flat()
    broken.colors = lambda *ray: Flat.colors(broken, *ray) / 0  # type: ignore[method-assign]
    with pytest.raises(Failure, match=r"image\[0, 0\] is inf at iteration 1") as caught:
        list(trainer(broken, 5).records())
    assert caught.value.status == "nan"
