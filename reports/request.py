"""What is asked of a table, and which results may answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from padgs.results import Result
from reports.table import ReportError


@dataclass(frozen=True)
class Request:
    """How a table is to be made."""

    protocol: str = "paper"
    mix: bool = False  # let different rules, sizes and run lengths stand in one block
    where: Mapping[str, str] = field(default_factory=dict)  # dotted configuration key -> the value wanted

    def admits(self, result: Result) -> bool:
        """Whether a result may enter the table."""
        return all(str(setting(result, key)) == value for key, value in self.where.items())


INPUT_RANGES = {"01": "[0, 1]", "11": "[-1, 1]"}


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


def refuse_mixture(results: Sequence[Result], request: Request, where: str) -> None:
    """Results of one block must have been made and scored alike.

    Raises:
        ReportError: they were not, and the request does not say that this is meant.
    """
    if request.mix:
        return
    for what, of in CONDITIONS.items():
        found: dict[str, str] = {}
        for result in results:
            value = of(result, request.protocol)
            if value is not None:
                found.setdefault(value, result.run)
        if len(found) > 1:
            examples = "; ".join(f"{value} in {run}" for value, run in found.items())
            raise ReportError(
                f"{where}: results differ in {what} ({examples}); choose with --where, or say --mix if this is meant"
            )


def _rules(result: Result, protocol: str) -> str | None:
    scores = result.scores.get(protocol)
    rules = scores.protocol if scores else result.config.get("protocol", {}).get(protocol)
    if rules is None:
        return None  # a run that was never scored under this protocol contradicts nothing
    words = [protocol, f"LPIPS-{rules.get('lpips')} fed {INPUT_RANGES.get(rules.get('lpips_inputs', ''))}"]
    if rules.get("bottom_crop"):
        words.append(f"without the last {100 * rules['bottom_crop']:.1f} % of the rows")
    return ", ".join(words)


CONDITIONS = {
    "protocol": _rules,
    "resolution": lambda result, protocol: f"{result.width}x{result.height}",
    "iterations": lambda result, protocol: str(result.iterations),
    "data": lambda result, protocol: result.fingerprint[:10],
}
