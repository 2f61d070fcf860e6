"""What is asked of a table, and which results may answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from padgs.results import Result
from reports.tables.table import ReportError


@dataclass(frozen=True)
class Request:
    """How a table is to be made."""

    protocol: str = "paper"
    mix: bool = False  # let different rules, sizes and run lengths stand in one block
    metrics: tuple[str, ...] = ()  # of the curves; empty for those of the protocol and the costs
    experiment: str = ""  # only runs of this experiment or sweep, by the name that results give it
    where: Mapping[str, str] = field(default_factory=dict)  # dotted configuration key -> the value wanted


def admitted(results: Sequence[Result], request: Request) -> list[Result]:
    """The results that a request lets in.

    Raises:
        ReportError: no result knows the experiment or a key that it asks for; the message lists those that are known.
    """
    known = sorted({name for result in results for name in result.experiments})
    if request.experiment and request.experiment not in known:
        raise ReportError(f"unknown experiment {request.experiment!r}; known: {', '.join(known) or 'none'}")
    for key in request.where:
        if results and all(value_of(result, key) is None for result in results):
            raise ReportError(
                f"unknown key {key!r}; known in run {results[0].run}: {', '.join(_keys(results[0].config))}"
            )
    return [
        result
        for result in results
        if (not request.experiment or request.experiment in result.experiments)
        and all(str(value_of(result, key)) == value for key, value in request.where.items())
    ]


def value_of(result: Result, key: str) -> Any:
    """The value of a dotted key of a result's configuration; None where its method or version has no such key."""
    value: Any = result.config
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _keys(config: Mapping[str, Any], where: str = "") -> list[str]:
    """All dotted keys of a configuration."""
    return [
        inner
        for key, value in config.items()
        for inner in (_keys(value, f"{where}{key}.") if isinstance(value, Mapping) else [f"{where}{key}"])
    ]
