"""What an iteration sees, said without torch."""

from made_up import result

from padgs.reports.images_seen import images_seen


def test_rays_count_as_pixels_and_all_else_as_whole_panoramas():
    rays = {"method": "egonerf", "width": 2048, "height": 1024, "config": {"method": {"rays": 4096}}}
    assert images_seen(result(**rays)) == 30_000 / 512
    for method in ("padgs", "cubemap_3dgs"):
        assert images_seen(result(method=method, iterations_done=120)) == 120
    assert images_seen(result(method="egonerf", config={})) is None
