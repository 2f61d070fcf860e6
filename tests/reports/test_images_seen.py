"""What an iteration sees is said without torch; here it is held against what the methods cut and draw."""

import pytest
from made_up import result

from baselines.crops_3dgs import Crops3DGSMethod, Crops3DGSOptions
from baselines.cubemap_3dgs import Cubemap3DGSMethod
from padgs.sphere.camera import Panorama
from reports.images_seen import images_seen

SIZE = {"width": 2048, "height": 1024}


@pytest.mark.parametrize(
    ("name", "method", "options"),
    [
        ("cubemap_3dgs", Cubemap3DGSMethod(), {}),
        *(
            ("crops_3dgs", Crops3DGSMethod(Crops3DGSOptions(field_of_view=degrees)), {"field_of_view": degrees})
            for degrees in (75.0, 90.0)
        ),
    ],
)
def test_perspective_views_count_with_their_pixels(name, method, options):
    lens = method.lens(Panorama(2048, 1024))
    expected = 30_000 * lens.width * lens.height / (2048 * 1024)
    assert images_seen(result(method=name, config={"method": options}, **SIZE)) == pytest.approx(expected, rel=5e-3)


def test_rays_count_as_pixels_and_whole_panoramas_as_one():
    assert images_seen(result(method="egonerf", config={"method": {"rays": 4096}}, **SIZE)) == 30_000 / 512
    assert images_seen(result(iterations_done=120)) == 120
    assert images_seen(result(method="egonerf", config={})) is None
