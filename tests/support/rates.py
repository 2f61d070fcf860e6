"""Learning rates of parameter groups against their published ends."""

import pytest


def assert_log_linear(groups, ends: dict, iterations: int) -> None:
    """Check rates at the start, in the middle and at the end, and the parameters of each named group.

    `ends` is name -> (first rate, last rate, parameters).
    """
    found = {group.name: group for group in groups}
    for name, (first, last, parameters) in ends.items():
        rate = found[name].learning_rate
        rates = [rate(0), rate(iterations // 2), rate(iterations)]
        assert rates == pytest.approx([first, (first * last) ** 0.5, last]), name
        assert [id(p) for p in found[name].parameters] == [id(p) for p in parameters], name
