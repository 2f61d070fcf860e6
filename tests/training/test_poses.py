import math
from dataclasses import replace

import pytest
import torch
from support.tiny_scene import tiny_scene, truth

from padgs.baselines.sc_omnigs import SCOmniGSMethod
from padgs.geometry.similarity import Similarity
from padgs.render import RenderOptions, render
from padgs.training.corrections import PoseRefinement, align
from padgs.training.options import Budget

VIEWS = tiny_scene().train


def refinement() -> PoseRefinement:
    return PoseRefinement.of(VIEWS, scale=2.0)


def test_without_a_correction_no_bit_of_a_pose_changes():
    poses = refinement()
    for view in VIEWS:
        assert torch.equal(poses.refined(view).cam_from_world, view.cam_from_world)
    assert torch.equal(poses.poses(), poses.given)


def test_a_quaternion_turns_the_camera_about_its_own_centre():
    poses, angle = refinement(), 0.2
    with torch.no_grad():
        poses.quaternions[1].copy_(torch.tensor([math.cos(angle / 2), 0, math.sin(angle / 2), 0]) * 3)
    refined = poses.refined(VIEWS[1])
    torch.testing.assert_close(refined.center, VIEWS[1].center, atol=1e-12, rtol=0)
    turn = refined.cam_from_world[:3, :3] @ VIEWS[1].cam_from_world[:3, :3].T
    about_y = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    torch.testing.assert_close(turn, about_y.double(), atol=1e-6, rtol=0)


def test_a_shift_is_in_the_camera_frame_and_in_scene_units():
    poses = refinement()
    with torch.no_grad():
        poses.shifts[0].copy_(torch.tensor([0.0, 0.5, 0.0]))
    pose = poses.refined(VIEWS[0]).cam_from_world
    assert (pose - VIEWS[0].cam_from_world)[:3, 3].tolist() == [0.0, 1.0, 0.0]
    assert torch.equal(pose[:3, :3], VIEWS[0].cam_from_world[:3, :3])


def test_the_origin_of_the_world_does_not_matter():
    """The same parameters move a camera by the same amount, near the origin or a kilometre away."""
    far = torch.eye(4, dtype=torch.float64)
    far[:3, 3] = torch.tensor([1000.0, -500.0, 300.0])
    away = [replace(view, cam_from_world=view.cam_from_world @ far) for view in VIEWS]
    here, there = refinement(), PoseRefinement.of(away, scale=2.0)
    for poses in (here, there):
        with torch.no_grad():
            poses.quaternions[2].add_(torch.tensor([0.0, 0.1, -0.05, 0.02]))
            poses.shifts[2].add_(torch.tensor([0.1, 0.2, 0.3]))
    torch.testing.assert_close(here.poses()[2] @ far, there.poses()[2], atol=1e-9, rtol=0)


@pytest.mark.parametrize("projection", ["erp", "ray"])
def test_gradients_of_a_pose_are_those_of_differences(projection):
    """Through the renderer, in float64: every component of one view's quaternion and shift."""
    poses, gaussians = refinement().double(), truth().to(torch.float64)
    generator = torch.Generator().manual_seed(3)
    weight = torch.randn(VIEWS[3].height, VIEWS[3].width, 3, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        poses.quaternions[3].add_(torch.tensor([0.02, 0.01, -0.03, 0.02]))
        poses.shifts[3].add_(0.01)

    def loss() -> torch.Tensor:
        rendering = render(gaussians, poses.refined(VIEWS[3]), RenderOptions(projection), backend="torch")
        return (rendering.image * weight).sum()

    loss().backward()
    for parameter in (poses.quaternions[3], poses.shifts[3]):
        for k in range(len(parameter)):
            sides = []
            for step in (1e-6, -1e-6):
                with torch.no_grad():
                    parameter[k] += step
                    sides.append(loss().item())
                    parameter[k] -= step
            assert parameter.grad[k].item() == pytest.approx((sides[0] - sides[1]) / 2e-6, rel=1e-4, abs=1e-4)
    assert poses.quaternions[0].grad is None, "other views rest"


def test_what_all_corrections_share_is_taken_out():
    """A small similarity of the world, as corrections of its cameras, is gone; what single cameras did is left."""
    turn, growth, move = torch.tensor([0.002, -0.003, 0.001], dtype=torch.float64), 0.002, torch.tensor([0.01, 0, 0.02])
    poses = refinement().double()
    middle = torch.stack([view.center for view in VIEWS]).mean(0)
    for view, quaternion, shift in zip(VIEWS, poses.quaternions, poses.shifts, strict=True):
        rotation = view.cam_from_world[:3, :3]
        moved = move + growth * (view.center - middle) + torch.linalg.cross(turn, view.center - middle)
        with torch.no_grad():
            quaternion[1:] = -0.5 * rotation @ turn
            shift.copy_(-rotation @ moved / 2.0)
    assert align(poses.poses(), poses.given)[1].distance.max() < 1e-4, "it is one"
    poses.center()
    torch.testing.assert_close(poses.poses(), poses.given, atol=1e-8, rtol=0)
    with torch.no_grad():
        poses.shifts[1].add_(0.1)
        poses.quaternions[2][1:] += 0.01
    poses.center()
    world, left = align(poses.poses(), poses.given)
    assert abs(world.scale - 1) < 1e-3 and (world.rotation - torch.eye(3)).norm() < 1e-3 and left.distance.max() > 0.1


def test_names_decide():
    with pytest.raises(ValueError, match="several training views are called '00'"):
        PoseRefinement.of([VIEWS[0], VIEWS[0]], scale=1.0)


def test_alignment_finds_a_similarity_and_maps_poses_by_it(generator):
    """Poses moved by a similarity: a point of the given world lands where the moved cameras say, exactly."""
    turn = torch.tensor([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]], dtype=torch.float64)
    similarity = Similarity(1.7, turn, torch.randn(3, generator=generator, dtype=torch.float64))
    given = torch.stack([view.cam_from_world for view in VIEWS])
    found, left = align(torch.stack([similarity.pose(pose) for pose in given]), given)
    assert found.scale == pytest.approx(1.7) and left.distance.max() < 1e-9 and left.degrees.max() < 1e-6
    point = torch.randn(3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(found.inverse()(found(point)), point)
    for pose in given:
        before, mapped = pose[:3, :3] @ point + pose[:3, 3], found.pose(pose)
        torch.testing.assert_close(mapped[:3, :3] @ found(point) + mapped[:3, 3], 1.7 * before)


def test_alignment_of_cameras_in_one_place_has_scale_1():
    poses = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    found, left = align(poses, poses)
    assert found.scale == 1 and not left.distance.any()


def test_views_in_one_place_have_no_scale_to_follow():
    views = tuple(replace(view, cam_from_world=torch.eye(4, dtype=torch.float64)) for view in VIEWS)
    with pytest.raises(ValueError, match="the 5 training cameras of scene .* stand in one place, which has no scale"):
        SCOmniGSMethod().fit(replace(tiny_scene(), train=views), Budget(10))


def test_budgets_of_seconds_are_measured_on_one_view_of_many_places():
    assert list(SCOmniGSMethod().fit(tiny_scene(), Budget(1, seconds=0.5)))
