"""What one row may do to a run, with a guard and without."""

import math

import pytest
import torch
from support.composed import composed
from support.states import assert_same_but_time
from support.tiny_scene import tiny_scene
from torch import nn

from padgs.runs.run import build_method
from padgs.training.health import MAX_ANISOTROPY, MIN_SCALE, Failure, Guard
from padgs.training.options import Budget
from padgs.training.schedule import Constant, ParameterGroup


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


GUARDED = ("train.monitor=false", "train.guard_gradients=true")
TOLD = "cleaned {} rows whose gradients were not finite"


def begun(preset: str, name: str, rows: slice, *settings: str, steps: int = 6):
    """A method whose first step has gradients that are NaN, and its records to come."""
    method = build_method(composed(f"method={preset}", *settings))
    records = method.fit(tiny_scene(), Budget(steps))
    Poison({group.name: group.parameters[0] for group in method.model.groups()}[name], rows)
    return method, records


@pytest.mark.parametrize(
    ("preset", "name"), [("omnigs", "means"), ("padgs_plus", "sh_dc"), ("padgs", "features"), ("cubemap_3dgs", "quats")]
)
@pytest.mark.parametrize("every", [1, 50])  # 50: the end of the run is looked at, too
def test_one_bad_row_is_left_out_and_told_of(preset, name, every):
    with pytest.raises(Failure, match="not finite|nan"):
        list(begun(preset, name, slice(2, 3), f"train.check_every={every}", "train.monitor=false")[1])
    method, records = begun(preset, name, slice(2, 3), f"train.check_every={every}", *GUARDED)
    assert TOLD.format(1) in [event for record in records for event in record.events]
    assert all(tensor.isfinite().all() for tensor in method.state().tensors.values() if tensor.is_floating_point())


@pytest.mark.parametrize(("preset", "name"), [("omnigs", "means"), ("padgs", "features"), ("padgs", "color")])
@pytest.mark.parametrize("count", [2, 9])
def test_many_bad_rows_and_bad_networks_end_a_run(preset, name, count):
    with pytest.raises(Failure) as caught:
        list(begun(preset, name, slice(0, count), *GUARDED)[1])
    assert caught.value.status == "nan"


@pytest.mark.parametrize("count", [1, 9])
def test_a_resumed_run_forgets_no_bad_row(count):
    method, records = begun("omnigs", "means", slice(0, count), "train.check_every=4", *GUARDED)
    next(records)
    other = build_method(composed("method=omnigs", "train.check_every=4", *GUARDED))
    other.load_state(method.state())
    rest = other.fit(tiny_scene(), Budget(6))
    if count == 1:
        assert [event for record in rest for event in record.events if "rows" in event] == [TOLD.format(1)]
    else:
        with pytest.raises(Failure, match="9 rows"):
            list(rest)


@pytest.mark.parametrize("preset", ["omnigs", "padgs"])
def test_a_guard_without_cause_changes_nothing(preset):
    states = []
    for settings in ((), ("train.guard_gradients=true", "train.guard_scales=true")):
        method = build_method(composed(f"method={preset}", *settings))
        list(method.fit(tiny_scene(), Budget(5)))
        states.append(method.state())
        states[-1].values.pop("guard")
    assert_same_but_time(*states)


@pytest.mark.parametrize("others", [0, 3])  # columns of anchors that are no axes
def test_scales_stay_within_the_bounds_of_the_beginning(others):
    scene = tiny_scene()
    farthest = (scene.points.double() - scene.train[0].center).norm(dim=-1).max().item()
    assert farthest > scene.scale
    scales = nn.Parameter(torch.full((3, others + 3), math.log(0.1)))
    group = ParameterGroup("log_scales", (scales,), Constant(1.0), is_of_rows=True)
    state = Guard([group], scene, gradients=False, scales=True).state
    with torch.no_grad():
        scales[0], scales[1], scales[2, -1] = 50.0, -50.0, -12.0
    guard = Guard([group], scene, gradients=False, scales=True)
    guard.load(state)
    guard.bound()
    assert torch.allclose(scales[0, others:].exp(), torch.tensor(farthest, dtype=torch.float32))
    assert torch.allclose(scales[1, others:].exp() / scene.scale, torch.tensor(MIN_SCALE))
    assert scales[2, others:].exp().tolist() == pytest.approx([0.1, 0.1, 0.1 / MAX_ANISOTROPY], rel=1e-5)
    assert (scales[:2, :others].abs() == 50).all()
