import time
from dataclasses import replace

from support.tiny_scene import tiny_scene

from padgs.evaluation import scoring


def test_frames_are_timed_in_cpu_time_several_times():
    seen = []

    def render(view):
        seen.append(view.name)
        time.sleep(0.01)

    scene = replace(tiny_scene(), test=tiny_scene().train)
    times = scoring.frame_times(render, scene)
    assert [*times] == ["render_ms_min", "render_ms_median"] and times["render_ms_min"] <= times["render_ms_median"] < 5
    assert seen[1:] == scoring.REPEATS * ["00", "02", "04"], "evenly spread, after a warm-up"
