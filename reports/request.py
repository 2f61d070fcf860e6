"""What is asked of a table, and which results may answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from padgs.results import Result
from reports.table import ReportError


@dataclass(frozen=True)
class Request:
    """How a table is to be made."""

    protocol: str = "paper"
    mix: bool = False  # let different rules, sizes and run lengths stand in one block
    metrics: tuple[str, ...] = ()  # of the curves; empty for those of the protocol and the costs
    experiment: str = ""  # only runs of this experiment or sweep, by the name that results give it
    where: Mapping[str, str] = field(default_factory=dict)  # dotted configuration key -> the value wanted

    def admits(self, result: Result) -> bool:
        """Whether a result may enter the table."""
        if self.experiment and self.experiment not in result.experiments:
            return False
        return all(str(setting(result, key)) == value for key, value in self.where.items())


def setting(result: Result, key: str) -> Any:
    """The value of a dotted key of a result's configuration.

    Raises:
        ReportError: there is no such key; the message lists its neighbours.
    """
    values: Any = result.config
    for depth, part in enumerate(key.split(".")):
        if not isinstance(values, Mapping) or part not in values:
            known = ", ".join(values) if isinstance(values, Mapping) else "none"
            place = ".".join(key.split(".")[:depth]) or "the configuration"
            raise ReportError(f"unknown key {key!r}; known in {place} of run {result.run}: {known}")
        values = values[part]
    return values
