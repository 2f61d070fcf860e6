"""What training learns of its views, in whole methods."""

from dataclasses import replace

import pytest
import torch
from composed import composed
from states import assert_same_but_time
from tiny_scene import tiny_scene

from baselines.omnigs import OmniGSMethod
from padgs.learning.budget import Budget
from padgs.learning.loop import TrainOptions
from padgs.scene import Scene
from padgs.scoring.metrics import psnr
from padgs.stress.options import StressOptions

GIVEN = TrainOptions(weight="uniform")
LEARNING = replace(GIVEN, exposures="learned", poses="learned")


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))


def stressed(condition: str) -> Scene:
    return StressOptions(condition, 3).scene(tiny_scene(), 1)


def trained(scene: Scene, train: TrainOptions, iterations: int = 150) -> OmniGSMethod:
    method = OmniGSMethod(train=train, seed=0)
    list(method.fit(scene, Budget(iterations)))
    return method


def quality(method: OmniGSMethod) -> float:
    view = tiny_scene().test[0]
    return float(psnr(method.render(view).image, view.image()))


@pytest.mark.parametrize(("condition", "part"), [("exposure", "exposures"), ("pose_noise", "poses")])
def test_learning_what_is_wrong_with_the_views_saves_the_model(condition, part):
    scene = stressed(condition)
    given, learned = (quality(trained(scene, replace(GIVEN, **{part: how}))) for how in ("given", "learned"))
    assert learned > given + 1


def test_held_out_views_have_the_mean_exposure():
    state = trained(stressed("exposure"), LEARNING, 10).state()
    for name in ("log_gains", "offsets"):
        own = torch.stack(list(state.under(f"views/exposures.{name}.").values()))
        assert own.abs().max() > 0.01 and own.mean(0).abs().max() < 1e-6


def test_going_on_changes_nothing():
    whole = trained(tiny_scene(), LEARNING, 12)
    torch.manual_seed(0)
    first = OmniGSMethod(train=LEARNING, seed=0)
    records = first.fit(tiny_scene(), Budget(12))
    for _ in range(7):
        next(records)
    second = OmniGSMethod(train=LEARNING, seed=0)
    second.load_state(first.state())
    list(second.fit(tiny_scene(), Budget(12)))
    a, b = whole.state(), second.state()
    assert any(name.startswith("adam/exposure_log_gains") for name in a.tensors)
    a.tensors.pop("random/torch"), b.tensors.pop("random/torch")
    assert_same_but_time(a, b)


def test_runs_that_learn_nothing_of_views_are_what_they_were_before_any_could():
    assert not {"exposures", "poses"} & composed().values()["train"].keys()
    assert composed("train.exposures=learned").values()["train"]["exposures"] == "learned"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (("train.exposures=some",), "unknown exposures 'some'; known: given, learned"),
        (("method=egonerf", "train.exposures=learned"), "so train.exposures=learned means nothing to it"),
        (("method=sc_omnigs", "train.poses=learned"), "learns poses by itself"),
        (
            ("method=egonerf", "method.environment_pretraining=7", "train.iterations=7"),
            "environment_pretraining is 7 of 7 iterations",
        ),
        (("method=egonerf", "budget.gaussians=7"), "EgoNeRF has no Gaussians"),
    ],
)
def test_what_cannot_be_learned_is_refused_when_a_run_is_composed(settings, said):
    with pytest.raises(ValueError, match=said):
        composed(*settings)
