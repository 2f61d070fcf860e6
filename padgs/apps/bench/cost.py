"""What each stage has to do at least, in operations and bytes, and how long that takes at the machine's ceilings.

Symbols: A anchors, N Gaussians decoded, I tile instances, E evaluated pairs, P pixels, S scalars of the model. One lane
of one vector instruction counts as 2 operations, because at the ceiling it would be a multiply-add.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from padgs.apps.bench.ceilings import Ceiling
from padgs.methods.anchors.model import PaDGSOptions

EXP_LANES = 8  # lane instructions of the exponential's polynomial
BLEND_LANES, BLEND_BACKWARD_LANES = 20 + EXP_LANES, 55 + EXP_LANES  # per evaluated pair
ADAM_BYTES = 28  # per scalar: parameter, gradient and two moments read, all but the gradient written
ADAM_OPERATIONS = 12


@dataclass(frozen=True)
class Cost:
    """The least work of a stage."""

    operations: float
    bytes: float

    def floor(self, ceilings: dict[str, Ceiling]) -> tuple[float, str]:
        """CPU seconds at the ceilings, and which of the two binds: arithmetic or memory."""
        arithmetic = self.operations / ceilings["fma"].per_cpu_second
        memory = self.bytes / ceilings["triad"].per_cpu_second
        return (arithmetic, "arithmetic") if arithmetic >= memory else (memory, "memory")


def costs(size: dict[str, Any]) -> dict[str, Cost]:
    """Stage -> cost, for the stages that there is a model of; from the counters of a size in a report."""
    model, counters, p = PaDGSOptions(), size["counters"], size["width"] * size["height"]
    a, n, i, e, s = (counters[name] for name in ("anchors", "gaussians", "instances", "evaluated", "parameters"))
    # First layers of three networks, and 1 + 3 + 7 outputs per Gaussian in the second: 14.1 k in the paper's model.
    decode = 2 * a * model.hidden * (3 * model.inputs + 11 * model.offsets)
    return {
        "decode": Cost(decode, 284 * a + 56 * n),
        "project": Cost(400 * n, 120 * n),
        "sort": Cost(0, 64 * n + 24 * i),
        "blend": Cost(2 * BLEND_LANES * e, 76 * i + 24 * p),  # instance 12 B and footprint 64 B; six floats per pixel
        "loss": Cost(3 * 700 * p, 3 * 50 * p),
        "blend_backward": Cost(2 * BLEND_BACKWARD_LANES * e, (76 + 128) * i + 36 * p),  # moments written and read
        "project_backward": Cost(1000 * n, 200 * n),
        "decode_backward": Cost(2 * decode, 568 * a + 112 * n),
        "optimiser": Cost(ADAM_OPERATIONS * s, ADAM_BYTES * s),
    }


def add_floors(size: dict[str, Any], ceilings: dict[str, Ceiling]) -> None:
    """Write floor (CPU seconds), bound and fraction of the ceiling beside each stage of a size, and their sum."""
    for name, cost in costs(size).items():
        seconds, bound = cost.floor(ceilings)
        size["stages"][name] |= {
            **asdict(cost),
            "floor": seconds,
            "bound": bound,
            "fraction": seconds / size["stages"][name]["cpu"]["min"],
        }
    size["floor"] = sum(timing.get("floor", 0.0) for timing in size["stages"].values())
