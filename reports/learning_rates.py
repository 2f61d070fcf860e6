"""The law of `train.learning_rates=run`, once more without torch; a test holds it against the one that trains."""

from __future__ import annotations

import math

PUBLISHED_ITERATIONS, LARGEST = 30_000, 8.0


def law(iterations: int) -> float:
    """The factor on all learning rates that `train.learning_rates=run` chooses: √(30 000 / iterations), in [1, 8].

    >>> law(30_000), law(7500), law(100)
    (1.0, 2.0, 8.0)
    """
    return min(max(math.sqrt(PUBLISHED_ITERATIONS / iterations), 1.0), LARGEST)
