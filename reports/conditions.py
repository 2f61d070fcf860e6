"""What results of one block must have in common, so that their numbers may be compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from padgs.results import Result
from reports.request import Request
from reports.tables.table import ReportError

Condition = Callable[[Result, str], "str | None"]  # of a result and a protocol; None contradicts nothing

INPUT_RANGES = {"01": "[0, 1]", "11": "[-1, 1]"}


def refuse_mixture(
    results: Sequence[Result], request: Request, where: str, conditions: Mapping[str, Condition] | None = None
) -> None:
    """Results of one block must have been made and scored alike.

    Raises:
        ReportError: they were not, and the request does not say that this is meant.
    """
    if request.mix:
        return
    for what, of in (CONDITIONS if conditions is None else conditions).items():
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


def machine(result: Result) -> str:
    """The hardware in a few words, with the version of torch."""
    known = result.machine
    where = known.get("gpu") or f"{known.get('cores')} cores of {known.get('cpu')}"
    return f"{where}, torch {known.get('torch')}"


def _machine_and_threads(result: Result, protocol: str) -> str | None:
    threads = result.machine.get("threads")
    return machine(result) + (f", {threads} threads" if threads else "")


CONDITIONS: Mapping[str, Condition] = {
    "protocol": _rules,
    "resolution": lambda result, protocol: f"{result.width}x{result.height}",
    "iterations": lambda result, protocol: str(result.iterations),
    "data": lambda result, protocol: result.fingerprint[:10],
}
OF_A_DATA_SET = {what: of for what, of in CONDITIONS.items() if what != "data"}  # scenes may differ, rules may not
OF_A_SWEEP = {"protocol": _rules, "machine": _machine_and_threads}  # all else shows as a changed key
OF_A_POINT = {"data": CONDITIONS["data"]}  # the folder of the data is no part of a setting
OF_A_CHART = {what: CONDITIONS[what] for what in ("protocol", "resolution", "data")} | {"machine": _machine_and_threads}
OF_A_MEAN = {**OF_A_DATA_SET, "machine": _machine_and_threads}  # of one setting over the scenes of a data set
OF_TIMES = {**CONDITIONS, "machine": _machine_and_threads}
