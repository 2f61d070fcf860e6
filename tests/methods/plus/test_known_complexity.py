"""What `budget=auto` takes of rooms of known complexity: more for more, and the same whatever points and units."""

import pytest
import torch

from padgs.multirun.composition import composing, configuration
from padgs.runs.run import build_method, load_scene

SMALL = ("width=128", "train_views=24", "test_views=2", "samples=4")
OBJECTS = ("scene=white_room", "objects=16")


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Of keys of the generator: as many Gaussians as such a room took."""
    known = {}

    def count(*keys: str) -> int:
        if keys not in known:
            generator = [f"data.generator.{key}" for key in (*SMALL, *keys)]
            with pytest.MonkeyPatch.context() as patch, composing():
                patch.setenv("PADGS_CACHE", str(tmp_path_factory.getbasetemp() / "rooms"))
                config = configuration([*generator, "budget=auto", "train.iterations=600", "tracking=none"])
                torch.manual_seed(config.seed)
                method, scene = build_method(config), load_scene(config, torch.device("cpu"))
                known[keys] = [record.counts["gaussians"] for record in method.fit(scene, config.time)][-1]
        return known[keys]

    return count


@pytest.mark.slow
def test_automatic_budget_grows_with_scene_complexity(taken):
    assert 1.2 * taken("scene=white_room") < taken(*OBJECTS)
    tiles = [taken("scene=checker_room", f"texture_frequency={frequency}") for frequency in (0.125, 0.5, 2)]
    assert 1.2 * taken("scene=white_room") < tiles[0] < tiles[1] < tiles[2]


@pytest.mark.slow
@pytest.mark.parametrize("change", ["points=10000", "points=40000", "world_scale=0.1", "world_scale=10"])
def test_automatic_budget_hardly_depends_on_points_and_units(taken, change):
    assert taken(*OBJECTS, change) == pytest.approx(taken(*OBJECTS), rel=0.15)
