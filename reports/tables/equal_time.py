"""Which runs count as trained for the same time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from padgs.results import Result
from reports.measures import train_seconds

EXPERIMENT = "equal_time"
TOLERANCE = 0.1  # of the time: what the same run takes twice differs by less on a quiet machine


def is_near(result: Result, seconds: float) -> bool:
    """Whether the training took that long, up to `TOLERANCE`."""
    taken = train_seconds(result)
    return taken is not None and abs(taken - seconds) <= TOLERANCE * seconds


def of_any_length(result: Result) -> Result:
    """The result as if its configuration did not say how long to train."""
    train = {key: value for key, value in result.config.get("train", {}).items() if key != "iterations"}
    return replace(result, config={**result.config, "train": train})


def common_seconds(results: Sequence[Result]) -> float:
    """The time that most runs took: of all training times the one with the most others near it, the shortest of such.

    Runs on the way to that time lie scattered.
    """
    times = sorted(seconds for result in results if result.ok and (seconds := train_seconds(result)))
    return max(times, key=lambda t: (sum(abs(other - t) <= TOLERANCE * t for other in times), -t), default=0.0)


def nearest_to(seconds: float, results: Sequence[Result]) -> list[Result]:
    """For each method and seed the run whose training time is nearest to `seconds`; failed runs where no other is."""
    best: dict[tuple[str, int], Result] = {}
    for result in results:
        key = (result.preset, result.seed)
        if key not in best or _distance(result, seconds) < _distance(best[key], seconds):
            best[key] = result
    return list(best.values())


def _distance(result: Result, seconds: float) -> float:
    taken = train_seconds(result)
    return abs(taken - seconds) if result.ok and taken else float("inf")
