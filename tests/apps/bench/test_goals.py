"""Goals: met, missed, or not measured."""

from padgs.apps.bench.goals import GOALS, judge


def timing(wall: float, cpu: float) -> dict:
    return {"wall": {"median": wall}, "cpu": {"min": cpu}}


def report() -> dict:
    return {
        "machine": {"threads": 2},
        "sizes": {
            "small": {"iteration": timing(0.010, 0.012)},
            "medium": {
                "render": timing(0.050, 0.09),
                "iteration": timing(0.096, 0.1),
                "stages": {"loss": timing(0.004, 0.006)},
                "rates": {"forward": 5e9, "backward": 0.5e9},
            },
        },
        "decode_10k": timing(0.001, 0.002),
        "bounds": {"exact": {"mean": 5.6, "max": 9}},
        "ratios": {"torch_renderer": {"cpu": 60.0}, **{name: {"cpu": 1.5} for name in ("tangent", "ray", "hybrid")}},
    }


def test_times_and_rates_are_judged_in_their_own_direction():
    found = {target["name"]: target for target in judge(report())}
    forward, backward = found["pairs blended per core"], found["pairs blended backward per core"]
    assert (forward["met"], forward["factor"]) == (True, 2.0)
    assert (backward["met"], backward["factor"]) == (False, 0.5)
    iteration = found["training iteration, 512x256, 100k"]
    assert (iteration["measured"], iteration["undisturbed"], iteration["factor"], iteration["met"]) == (
        96,
        50,
        0.5,
        False,
    )
    assert found["draw and back, 512x256, 100k"]["met"]
    assert found["torch renderer / native"]["factor"] == 2.0


def test_what_was_not_measured_is_neither_met_nor_missed():
    found = judge(report())
    assert [t["name"] for t in found if t["met"] is None] == [t.name for t in GOALS if "2048x1024" in t.name]
    assert len(judge({"sizes": {}, "machine": {"threads": 1}, "ratios": {}, "bounds": {}})) == len(GOALS)
