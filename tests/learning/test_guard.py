"""What one row may do to a run, with a guard and without."""

import math

import pytest
import torch
from composed import composed
from states import assert_same_but_time
from tiny_scene import tiny_scene
from torch import nn

from padgs.learning.budget import Budget
from padgs.learning.failure import Failure
from padgs.learning.guard import ANISOTROPY, SMALLEST, Guard
from padgs.learning.schedule import Constant, ParameterGroup
from padgs.runs.session import build

LOUD = ("train.check_every=1", "train.monitor=false")


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))


class Poison:
    """Makes gradients NaN, once, in the rows it is told."""

    def __init__(self, parameter: nn.Parameter, rows: slice) -> None:
        self.rows, self.handle = rows, parameter.register_hook(self)

    def __call__(self, gradient: torch.Tensor) -> torch.Tensor:
        self.handle.remove()
        gradient = gradient.clone()
        gradient[self.rows] = math.nan
        return gradient


def poisoned(preset: str, name: str, rows: slice, *settings: str):
    """A method after three steps, in the first of which some gradients were NaN, and what happened."""
    method, scene = build(composed(f"method={preset}", *LOUD, *settings)), tiny_scene()
    records = method.fit(scene, Budget(3))
    groups = {group.name: group.parameters[0] for group in method.trainee.groups()}
    Poison(groups[name], rows)
    return method, [event for record in records for event in record.events]


@pytest.mark.parametrize(("preset", "name"), [("omnigs", "means"), ("padgs_plus", "sh_dc"), ("padgs", "features")])
def test_one_bad_row_is_left_out_and_told_of(preset, name):
    with pytest.raises(Failure, match="not finite|nan"):
        poisoned(preset, name, slice(2, 3))
    method, events = poisoned(preset, name, slice(2, 3), "train.guard_gradients=true")
    assert "left out 1 rows whose gradients were not finite" in events
    assert all(tensor.isfinite().all() for tensor in method.state().tensors.values() if tensor.is_floating_point())
    assert method.state().values["left_out"] == 1


@pytest.mark.parametrize(("preset", "name"), [("omnigs", "means"), ("padgs", "features"), ("padgs", "color")])
def test_many_bad_rows_and_bad_networks_end_a_run(preset, name):
    with pytest.raises(Failure) as caught:
        poisoned(preset, name, slice(0, 9), "train.guard_gradients=true")
    assert caught.value.status == "nan"


@pytest.mark.parametrize("preset", ["omnigs", "padgs"])
def test_a_guard_without_cause_changes_nothing(preset):
    states = []
    for settings in ((), ("train.guard_gradients=true", "train.guard_scales=true")):
        method = build(composed(f"method={preset}", *LOUD, *settings))
        list(method.fit(tiny_scene(), Budget(5)))
        states.append(method.state())
    assert_same_but_time(*states)


@pytest.mark.parametrize("axes", [1, 2])  # anchors have two triples of them
def test_scales_stay_within_bounds(axes):
    scene = tiny_scene()
    farthest = (scene.points.double() - scene.train[0].center).norm(dim=-1).max().item()
    assert farthest > scene.unit
    scales = nn.Parameter(torch.full((3, 3 * axes), math.log(0.1)))
    group = ParameterGroup("log_scales", (scales,), Constant(1.0), is_of_rows=True)
    guard = Guard([group], scene, gradients=False, scales=True)
    with torch.no_grad():
        scales[0], scales[1], scales[2, -1] = 50.0, -50.0, -12.0
    guard.bound()
    assert torch.allclose(scales[0].exp(), torch.tensor(farthest, dtype=torch.float32))
    assert torch.allclose(scales[1].exp() / scene.unit, torch.tensor(SMALLEST))
    assert scales[2, -1].exp().item() == pytest.approx(0.1 / ANISOTROPY, rel=1e-5)
    assert scales[2, :-1].exp().tolist() == pytest.approx([0.1] * (3 * axes - 1))
