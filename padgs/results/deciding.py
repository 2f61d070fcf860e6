"""Which keys of a configuration decide what a run comes to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Keys that no trained number depends on but by rounding: of the machine, and the others. What was
# read is said by the fingerprint of the data; scoring comes after training; a monitor changes no number, but may end a
# run. `data.device` is in files of old runs only.
OF_THE_MACHINE = ("run", "render.max_instances", "data.cache_bytes", "data.prefetch_threads", "data.device")
DECIDE_NOTHING = (*OF_THE_MACHINE, "data.path", "init.run", "protocol", "train.monitor")


def decisive(config: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """A configuration without the keys that decide nothing.

    >>> decisive({"seed": 0, "run": {"threads": 2}, "data": {"path": "/x", "width": 64}})
    {'seed': 0, 'data': {'width': 64}}
    """
    return {
        key: decisive(value, f"{where}{key}.") if isinstance(value, Mapping) else value
        for key, value in config.items()
        if f"{where}{key}" not in DECIDE_NOTHING
    }
