"""How many rooms a scene is."""

from dataclasses import replace

import pytest
import torch

from padgs.data.perturb import StressOptions
from padgs.data.synthetic import SyntheticOptions, generate
from padgs.methods.plus.depth_initialization import room_count
from padgs.methods.plus.method import PlusMethod, PlusOptions


@pytest.fixture(autouse=True)
def cached(monkeypatch, cache):
    monkeypatch.setenv("PADGS_CACHE", str(cache))


def scene_of(name: str, count: int = 1):
    views, points = 8 * count, 3000 * count
    return generate(
        SyntheticOptions(
            scene=name,
            rooms=count if name == "room_chain" else None,
            width=16,
            samples=1,
            train_views=views,
            test_views=1,
            points=points,
        )
    )


def test_more_rooms_are_more_and_one_is_one():
    one, two, five = (room_count(scene_of("room_chain", count)) for count in (1, 2, 5))
    assert one == 1.0 < two < five
    assert 1.5 < five < 5


@pytest.mark.parametrize("name", ["room", "outdoor", "near_clutter"])
def test_furniture_and_trees_make_no_room(name):
    assert room_count(scene_of(name)) == 1.0


@pytest.mark.parametrize(("condition", "level"), [("world_scale", 3), ("world_offset", 2), ("world_rotation", 3)])
def test_the_world_may_be_anywhere(condition, level):
    scene = scene_of("room_chain", 3)
    assert room_count(StressOptions(condition, level).apply(scene, 0)) == pytest.approx(room_count(scene), rel=0.1)


def test_points_that_are_none_count_as_nothing():
    scene = scene_of("room_chain", 2)
    lost = replace(scene, points=torch.cat((scene.points, torch.full((9, 3), torch.nan))))
    assert room_count(lost) == pytest.approx(room_count(scene), rel=0.01)
    assert room_count(replace(scene, points=scene.points[:0])) == 1.0
    here = scene.train[0].center.float().expand(3, 3)
    assert room_count(replace(scene, points=here)) >= 1.0


def test_a_row_of_rooms_may_have_more_gaussians_than_one():
    """With as many points and views, the row begins with more of them."""
    row = scene_of("room_chain", 5)
    near = row.train[0].center
    one = replace(row, points=near + 0.3 * torch.nn.functional.normalize(row.points - near, dim=-1))
    method = PlusMethod(PlusOptions(sky_per_point=0.0, depth_init_per_pixel=0.0))
    starts = [len(method.build_model(scene, 100).splats) for scene in (one, row)]
    assert starts[1] == pytest.approx(room_count(row) * starts[0], rel=0.01)
