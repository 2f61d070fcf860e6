"""Which runs count as trained for the same time."""

from __future__ import annotations

from typing import Any

import numpy as np
from pandas import DataFrame

EXPERIMENT = "equal_time"
TOLERANCE = 0.1  # of the time: what the same run takes twice differs by less on a quiet machine


def is_near(taken: Any, seconds: float) -> Any:
    """Whether the training took that long, up to `TOLERANCE`; of one run or a column of many."""
    return abs(taken - seconds) <= TOLERANCE * seconds


def of_any_length(runs: DataFrame) -> DataFrame:
    """The runs as if their configuration did not say how long to train."""
    return runs.drop(columns="config.train.iterations", errors="ignore")


def common_seconds(runs: DataFrame) -> float:
    """The time that most runs took: of all training times the one with the most others near it, the shortest of such.

    Runs on the way to that time lie scattered.
    """
    times = sorted(runs.loc[runs["ok"], "train_seconds"].dropna())
    return max(times, key=lambda t: (sum(abs(other - t) <= TOLERANCE * t for other in times), -t), default=0.0)


def nearest_to(seconds: float, runs: DataFrame) -> DataFrame:
    """For each method and seed the run whose training time is nearest to `seconds`; failed runs where no other is."""
    distance = (runs["train_seconds"].where(runs["ok"]) - seconds).abs().fillna(np.inf)
    return runs.loc[distance.groupby([runs["preset"], runs["seed"]], sort=False).idxmin()]
