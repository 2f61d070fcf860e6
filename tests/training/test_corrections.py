"""What training learns of its views, in whole methods."""

import math
from dataclasses import replace

import pytest
import torch
from support.composed import composed
from support.states import assert_same_but_time
from support.tiny_scene import tiny_scene, truth
from torch import nn

from padgs.baselines.omnigs import OmniGSMethod
from padgs.data.perturb import StressOptions
from padgs.data.perturb.images import change_pixels
from padgs.geometry.camera import Pinhole
from padgs.render import RenderOptions, render
from padgs.scene import Scene, View
from padgs.training.corrections import Corrections
from padgs.training.loop import Trainer
from padgs.training.model import TrainingRender
from padgs.training.options import Budget, TrainOptions
from padgs.training.schedule import Constant, ParameterGroup

GIVEN = TrainOptions(weight="uniform")
LEARNING = replace(GIVEN, exposures="learned", poses="learned")


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))


def stressed(condition: str) -> Scene:
    return StressOptions(condition, 3).apply(tiny_scene(), 1)


def trained(scene: Scene, train: TrainOptions, iterations: int = 150) -> OmniGSMethod:
    method = OmniGSMethod(train=train, seed=0)
    list(method.fit(scene, Budget(iterations)))
    return method


class Truth:
    """A trainee that knows the scene and learns nothing, so that only corrections of views are left to learn."""

    def __init__(self) -> None:
        self.unused = nn.Parameter(torch.zeros(1))

    def groups(self) -> list[ParameterGroup]:
        return [ParameterGroup("unused", (self.unused,), Constant(0.0))]

    def draw(self, view: View) -> TrainingRender:
        probe = torch.zeros(8, 2, requires_grad=True)
        rendering = render(truth(), view, RenderOptions(), mean_offsets=probe)
        return TrainingRender(rendering, probe, truth(), torch.arange(8))

    def observe(self, drawing: TrainingRender, iteration: int) -> None: ...

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        return ()

    def counts(self) -> dict[str, int]:
        return {"gaussians": 8}


def corrected(scene: Scene, train: TrainOptions, iterations: int = 250) -> Corrections:
    run = Trainer(Truth(), scene, Budget(iterations), train, seed=0)
    list(run.records())
    return run.corrections


def test_exposures_that_differ_are_found_but_for_their_mean():
    stops = torch.tensor([-0.3, 0.1, 0.2, 0.0, -0.2])
    views = tuple(
        change_pixels(view, lambda pixels, stop=stop: (pixels * 2**stop).clamp(0, 255).to(torch.uint8))
        for view, stop in zip(tiny_scene().train, stops, strict=True)
    )
    scene = replace(tiny_scene(), train=views)
    corrections = corrected(scene, replace(GIVEN, exposures="learned"))
    found = torch.stack(list(corrections.log_gains)).mean(1) / math.log(2)
    torch.testing.assert_close(found, stops - stops.mean(), atol=0.1, rtol=0)


def test_panoramas_keep_their_exposure_beside_photographs():
    scene = tiny_scene()
    photographs = [
        replace(view, name=f"photo-{view.name}", lens=Pinhole(32, 16, 20.0, 20.0, 16.0, 8.0)) for view in scene.train
    ]
    corrections = Corrections(replace(scene, train=(*scene.train, *photographs)), replace(GIVEN, exposures="learned"))
    with torch.no_grad():
        for own in list(corrections.offsets)[len(scene.train) :]:
            own += 0.5  # of photographs
    corrections.center()
    assert torch.stack(list(corrections.offsets)[: len(scene.train)]).abs().max() == 0


def test_poses_that_are_off_are_mended():
    exact = torch.stack([view.center for view in tiny_scene().train])
    scene = stressed("pose_noise")
    poses = corrected(scene, replace(GIVEN, poses="learned")).poses

    def off(centers: torch.Tensor) -> float:
        """How far centres are off, but for their mean."""
        moved = centers - exact
        return (moved - moved.mean(0)).norm(dim=1).mean().item()

    found = poses.poses()
    before = off(torch.stack([view.center for view in scene.train]))
    assert off(-(found[:, :3, :3].mT @ found[:, :3, 3:])[..., 0]) < 0.5 * before


def test_held_out_views_have_the_mean_exposure():
    state = trained(stressed("exposure"), LEARNING, 10).state()
    for name in ("log_gains", "offsets"):
        own = torch.stack(list(state.under(f"views/{name}.").values()))
        assert own.abs().max() > 1e-3 and own.mean(0).abs().max() < 1e-6


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


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (("train.exposures=some",), "unknown exposures 'some'; known: given, learned"),
        (("method=egonerf", "train.exposures=learned"), "so train.exposures=learned does not apply"),
        (("train.lens=fisheyes_w",), "unknown lens 'fisheyes_w'; known: given, map, fisheyes_x"),
        (("method=omnigs", "train.lens=fisheyes_z"), "requires a Panorama camera, not a RayTable"),
        (("method=padgs_ray", "train.lens=fisheyes_z"), "PaD-GS decodes others for each"),
        (("method=cubemap_3dgs", "train.lens=map"), "train.lens is map, but each of the views"),
        (("method=egonerf", "budget.gaussians=7"), "EgoNeRF has no Gaussians"),
        (("method=omnigs", "train.refine=true", "budget.gaussians=auto"), "with train.refine=true set a number"),
    ],
)
def test_what_cannot_be_learned_is_refused_when_a_run_is_composed(settings, said):
    with pytest.raises(ValueError, match=said):
        composed(*settings)
