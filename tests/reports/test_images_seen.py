"""What an iteration sees, said without torch."""

import pytest
import torch
from made_up import result

from padgs.reports.frame import images_seen
from padgs.scene import View
from padgs.training.targets import Sizes


def test_rays_count_as_pixels_and_all_else_as_whole_panoramas():
    rays = {"method": "egonerf", "width": 2048, "height": 1024, "config": {"method": {"rays": 4096}}}
    assert images_seen(result(**rays)) == 30_000 / 512
    for method in ("padgs", "cubemap_3dgs"):
        assert images_seen(result(method=method, iterations_done=120)) == 120
    assert images_seen(result(method="egonerf", config={})) is None


@pytest.mark.parametrize("width", [512, 1024, 2000, 4096])
def test_small_views_count_as_the_share_that_training_makes_them(width):
    view = View("a", torch.eye(4, dtype=torch.float64), width, width // 2)
    sizes = Sizes([view], "uniform", torch.device("cpu"), 0.3)
    seen = sum(0.25 ** sizes.halvings((i + 1) / 1000) for i in range(1000))
    own = {"method": "padgs_plus", "width": width, "height": width // 2, "iterations_done": 1000}
    options = {"method": {"coarse_share": 0.3}}
    assert images_seen(result(**own, config=options)) == pytest.approx(seen, rel=5e-3)
    timed = options | {"budget": {"seconds": 60.0, "clock": "cpu"}}
    for unknown in (result(**own, config=timed), result(**own, config=options, ended="less was gained")):
        assert images_seen(unknown) == (1000 if width < 1024 else None)
