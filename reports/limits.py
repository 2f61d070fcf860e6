"""What a run may lose under a condition and still have survived it: how much worse a mark may become at each level.

Conditions without a limit have none to hold: what they cost is shown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files

import yaml

MADE_FOR = ("256x128", 1500)  # resolution, and iterations without stress


@dataclass(frozen=True)
class Limit:
    """How far a mark of the protocol `stability` may go at each level from 1 on, as far as there is a limit."""

    levels: tuple[float, ...]
    mark: str = "ws_psnr"
    lost: bool = True  # against the same run without the condition, which has more; otherwise what it has itself


CONDITIONS = files("padgs").joinpath("data/perturb/conditions.yaml")  # the file explains itself


def _limit(allowed: Sequence[float], metric: str = "ws_psnr") -> Limit:
    return Limit(tuple(allowed), metric, lost=metric.startswith("ws_psnr"))


LIMITS: Mapping[str, Limit] = {
    name: _limit(**{key: row[key] for key in ("allowed", "metric") if key in row})
    for name, row in yaml.safe_load(CONDITIONS.read_text("utf-8")).items()
    if "allowed" in row
}
