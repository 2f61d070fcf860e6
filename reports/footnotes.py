"""Under what conditions the numbers of a table were made, in a sentence for all blocks that share them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from padgs.results import Result
from reports.conditions import CONDITIONS, machine


def conditions(blocks: Mapping[str, Sequence[Result]], protocol: str) -> list[str]:
    """Protocol with all its rules, resolution, iterations, seeds, code version and machine of the results of blocks."""
    titles: dict[str, list[str]] = {}
    for title, results in blocks.items():
        titles.setdefault(_sentence(results, protocol), []).append(title)
    return [f"{'; '.join(of)}: {sentence}" for sentence, of in titles.items()]


def _sentence(results: Sequence[Result], protocol: str) -> str:
    if not results:
        return "not run."
    rules, sizes, iterations = (_listed(CONDITIONS[what](r, protocol) for r in results) for what in _SHOWN)
    seeds = _listed(str(seed) for seed in sorted({result.seed for result in results}))
    versions = _listed(result.code_version for result in results)
    machines = _listed(machine(result) for result in results)
    return f"protocol {rules}, {sizes}, {iterations} iterations, seeds {seeds}, padgs {versions}, {machines}."


_SHOWN = ("protocol", "resolution", "iterations")


def _listed(values) -> str:
    return " / ".join(dict.fromkeys(value for value in values if value is not None)) or "none"
