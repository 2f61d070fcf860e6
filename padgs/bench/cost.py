"""What each stage has to do at least, in operations and bytes, and how long that takes at the machine's ceilings.

Symbols: A anchors, N Gaussians decoded, I tile instances, E evaluated pairs, P pixels. One lane of one vector
instruction counts as 2 operations, because at the ceiling it would be a multiply-add.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from padgs.anchors.model import PaDGSOptions
from padgs.bench.ceilings import Ceiling

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


def costs(
    *, anchors: int, gaussians: int, instances: int, evaluated: int, pixels: int, parameters: int, model: PaDGSOptions
) -> dict[str, Cost]:
    """Stage -> cost, for the stages that there is a model of."""
    a, n, i, e, p = anchors, gaussians, instances, evaluated, pixels
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
        "optimiser": Cost(ADAM_OPERATIONS * parameters, ADAM_BYTES * parameters),
    }


def add_floors(stages: dict[str, dict[str, Any]], least: dict[str, Cost], ceilings: dict[str, Ceiling]) -> None:
    """Write floor (CPU seconds), its bound, and the fraction of the ceiling that is reached beside each stage."""
    for name, timing in stages.items():
        if name in least:
            seconds, bound = least[name].floor(ceilings)
            timing["operations"], timing["bytes"] = least[name].operations, least[name].bytes
            timing["floor"], timing["bound"] = seconds, bound
            timing["fraction"] = seconds / timing["cpu"]["min"]
