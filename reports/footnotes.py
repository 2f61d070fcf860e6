"""Under what conditions the numbers of a block were made, in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.results import Result
from reports.request import CONDITIONS


def conditions(title: str, results: Sequence[Result], protocol: str) -> str:
    """Protocol with all its rules, resolution, iterations, seeds, code version and machine of some results."""
    if not results:
        return f"{title}: not run."
    rules, sizes, iterations = (_listed(CONDITIONS[what](r, protocol) for r in results) for what in _SHOWN)
    seeds = _listed(str(seed) for seed in sorted({result.seed for result in results}))
    versions = _listed(result.code_version for result in results)
    machines = _listed(machine(result) for result in results)
    return f"{title}: protocol {rules}, {sizes}, {iterations} iterations, seeds {seeds}, padgs {versions}, {machines}."


def machine(result: Result) -> str:
    """The hardware in a few words."""
    known = result.machine
    where = known.get("gpu") or f"{known.get('cores')} cores of {known.get('cpu')}"
    return f"{where}, torch {known.get('torch')}"


_SHOWN = ("protocol", "resolution", "iterations")


def _listed(values) -> str:
    return " / ".join(dict.fromkeys(value for value in values if value is not None)) or "none"
