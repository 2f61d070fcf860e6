import math
from dataclasses import replace

import pytest
from pandas import DataFrame
from support.made_up import run_set, small

from padgs.reports import selection
from padgs.reports.selection import Mixture, ReportError, Request, one_setting, select, separate, settings


def refused(*options) -> tuple[DataFrame, Mixture]:
    """Runs of a method with these options, a seed each, and why they are no setting."""
    configs = [{"method": own, "seed": seed} for seed, own in enumerate(options)]
    runs = run_set([small(25.0, seed=config["seed"], config=config) for config in configs]).runs
    with pytest.raises(Mixture) as caught:
        one_setting(runs, "room", "preset")
    return runs, caught.value


def test_a_key_that_is_not_set_is_a_difference():
    assert separate(*refused({}, {"share": 0.3}))["preset"].tolist() == ["padgs_share not set", "padgs_share 0.3"]


def test_values_may_be_lists():
    rates = [0.1, 0.2], [0.1, 0.3], 0.1
    names = separate(*refused(*({"rate": rate} for rate in rates)))["preset"].tolist()
    assert names == [f"padgs_rate {rate}" for rate in rates]


def test_what_no_words_tell_apart_is_refused_for_good():
    runs, mixture = refused({"share": 1}, {"share": "1"})
    with pytest.raises(Mixture, match="differ in method.share"):
        separate(runs, mixture)


def test_seeds_from_before_and_after_a_key_existed_have_rows_of_their_own():
    of = run_set([small(25.0, seed=seed, config={"method": own}) for seed, own in enumerate(({}, {"share": 0.3}))])
    assert [row.title for row in of.report("methods").blocks[0].rows] == ["PaD-GS, share 0.3", "PaD-GS, share not set"]
    assert "differ in method.share" in "".join(of.warnings)


def test_settings_of_a_variant_have_different_titles_though_another_variant_has_one_setting():
    own = {"": (0.9,), "a1": (0.5, 0.9)}
    runs = [
        replace(small(25.0), variant=name, run=f"{name}_{tau}", config={"method": {"tau": tau}})
        for name, of in own.items()
        for tau in of
    ]
    titles = [setting.title for setting in settings(run_set(runs).runs)]
    assert titles == ["PaD-GS, tau 0.9", "PaD-GS, a1, tau 0.5", "PaD-GS, a1, tau 0.9"]


def test_conditions_all_hold():
    """Names by their option and as a setting; null is a value, also of a key that is null in all runs."""
    stated = [("padgs", "flat", None), ("padgs", "room", 64), ("spags", "flat", 64), ("spags", "room", None)]
    stated.append(("spags", "Hall, old", 32))
    found = []
    for seed, (method, scene, width) in enumerate(stated):
        config = {"data": {"width": width, "points": None}}
        found.append(small(25.0, seed=seed, method=method, preset=method, scene=scene, config=config))
    runs = run_set(found).runs

    def chosen(**asked) -> list[int]:
        return sorted(select(runs, Request(**asked))["seed"])

    assert chosen(where={"method": "padgs"}) == [0, 1] == chosen(methods=("padgs",))
    assert chosen(methods=("padgs", "spags"), where={"method": "padgs", "scene": "flat"}) == [0]
    assert chosen(where={"scene": "flat,room"}) == [0, 1, 2, 3]
    assert chosen(where={"scene": "Hall, old"}) == [4], "a name with a comma"
    with pytest.raises(ReportError, match="no run has method spags; runs have padgs, spags"):
        chosen(methods=("padgs",), where={"method": "spags"})
    assert chosen(where={"data.width": "null"}) == [0, 3] == chosen(where={"data.width": "None"})
    assert chosen(where={"data.width": "64"}) == [1, 2]
    assert chosen(where={"data.points": "null"}) == [0, 1, 2, 3, 4]
    with pytest.raises(ReportError, match="no run has data.points=5; runs have null"):
        chosen(where={"data.points": "5"})


@pytest.mark.parametrize(
    ("stored", "text", "same"),
    [
        *((60.0, "60", True), (True, "true", True), ("room", "rooms", False), ([1, 2], "[1,2]", True)),
        *(([0.01, 0.0001], "[0.01, 0.0001]", True), (math.nan, "null", True), (None, "None", True)),
    ],
)
def test_texts_that_mean_a_stored_value(stored, text, same):
    assert selection._is_value(stored, text) == same
