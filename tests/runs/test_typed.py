from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest

from padgs.checks import ConfigError, typed


@dataclass(frozen=True)
class Inner:
    tau: float = 0.9
    size: float | str = "auto"
    pair: tuple[float, float] = (1.0, 2.0)
    names: tuple[str, ...] = ()

    def __post_init__(self):
        if self.tau > 1:
            raise ValueError(f"tau is {self.tau}; it must be at most 1")


@dataclass(frozen=True)
class Outer:
    steps: int
    wrap: bool = True
    limit: float | None = None
    inner: Inner = field(default_factory=Inner)
    knobs: Mapping[str, Any] = field(default_factory=dict)


def test_defaults_are_those_of_the_dataclass():
    assert typed(Outer, {"steps": 3}) == Outer(3)


def test_nested_values_and_tuples():
    built = typed(Outer, {"steps": 3, "inner": {"pair": [3, 4], "names": ["a"]}, "knobs": {"scene": "room"}})
    assert built == Outer(3, inner=Inner(pair=(3.0, 4.0), names=("a",)), knobs={"scene": "room"})


def test_numbers_become_the_type_of_the_field_so_that_equal_settings_are_equal():
    built = typed(Outer, {"steps": 1e3, "limit": 5, "inner": {"tau": 1, "size": 2}})
    assert repr(built) == repr(Outer(1000, limit=5.0, inner=Inner(tau=1.0, size=2.0)))


def test_null_where_it_is_allowed():
    assert typed(Outer, {"steps": 1, "limit": None}).limit is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps": 1, "wrop": True}, "unknown key a.wrop; known: a.steps, a.wrap, a.limit, a.inner, a.knobs"),
        ({"steps": 1, "inner": {"tua": 1}}, "unknown key a.inner.tua; known: a.inner.tau"),
        ({}, "a.steps is not set"),
        ({"steps": 1.5}, "a.steps is 1.5; it must be a whole number"),
        ({"steps": True}, "a.steps is True; it must be a whole number"),
        ({"steps": "1"}, "a.steps is '1'; it must be a whole number"),
        ({"steps": 1, "wrap": 1}, "a.wrap is 1; it must be true or false"),
        ({"steps": 1, "wrap": None}, "a.wrap is None"),
        ({"steps": 1, "limit": "x"}, "a.limit is 'x'; it must be a number or null"),
        ({"steps": 1, "inner": 3}, "a.inner is 3; it must be a group of keys"),
        ({"steps": 1, "inner": {"pair": "x"}}, "a.inner.pair is 'x'; it must be a list of 2 values"),
        ({"steps": 1, "inner": {"names": 1}}, "a.inner.names is 1; it must be a list"),
        ({"steps": 1, "inner": {"pair": [1]}}, r"a.inner.pair is \[1\]; it must have 2 entries"),
        ({"steps": 1, "inner": {"tau": 2}}, "a.inner: tau is 2.0; it must be at most 1"),
    ],
)
def test_what_is_wrong_is_named(values, message):
    with pytest.raises(ConfigError, match=message):
        typed(Outer, values, "a")
