from dataclasses import replace
from typing import Any

import pytest
import torch
from tiny_scene import tiny_scene

from padgs.data.synthetic import SyntheticOptions, generate
from padgs.methods.egonerf.field import EgoNeRF, cloud_reach, surroundings_of
from padgs.methods.egonerf.options import EgoNeRFOptions
from padgs.scene import View

TINY: dict[str, Any] = {"width": 32, "train_views": 4, "test_views": 1, "samples": 1, "points": 600}


@pytest.mark.parametrize(("scene", "kind"), [("room", "indoor"), ("outdoor", "outdoor")])
def test_rooms_and_the_open_are_told_apart_in_any_unit(tmp_path, monkeypatch, scene, kind):
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path))
    found = [generate(SyntheticOptions(scene, **TINY, world_scale=scale)) for scale in (1.0, 100.0)]
    assert [surroundings_of(one) for one in found] == [kind, kind]
    assert cloud_reach(found[1]) == pytest.approx(cloud_reach(found[0]), rel=1e-3)


def test_a_few_points_behind_the_walls_make_no_outdoors():
    shell = torch.nn.functional.normalize(torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    scene = tiny_scene()
    still: View = replace(scene.train[0], cam_from_world=torch.eye(4, dtype=torch.float64))
    for outliers, kind in ((30, "indoor"), (80, "outdoor")):
        points = shell.clone()
        points[:outliers] *= 50
        assert surroundings_of(replace(scene, train=(still,), points=points)) == kind


def test_what_is_given_comes_before_what_the_surroundings_say():
    small: dict[str, Any] = {"radial_nodes": 4, "polar_nodes": 4, "azimuth_nodes": 4, "environment_height": 4}
    chosen = EgoNeRF.from_scene(tiny_scene(), EgoNeRFOptions(**small))
    assert chosen.kind == surroundings_of(tiny_scene())
    options = EgoNeRFOptions(**small, surroundings="indoor", far=7.0, environment=True)
    model = EgoNeRF.from_scene(tiny_scene(), options)
    assert model.kind == "indoor" and model.environment is not None
    assert (model.constants.far, model.constants.density_shift) == (7.0, -8.0)
    with pytest.raises(ValueError, match="unknown surroundings 'cellar'; known: auto, outdoor, indoor"):
        EgoNeRFOptions(surroundings="cellar")
