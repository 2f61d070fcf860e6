"""Under what conditions the numbers of a table were made, in a sentence for all blocks that share them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from padgs.results import Result
from reports.conditions import CONDITIONS, machine
from reports.methods import title

PUBLISHED_LENGTHS = {"egonerf": 100_000}  # iterations; of the others 30 000, which tables of the paper have


def conditions(blocks: Mapping[str, Sequence[Result]], protocol: str) -> list[str]:
    """Protocol with all its rules, resolution, iterations, seeds, code version and machine of the results of blocks."""
    titles: dict[str, list[str]] = {}
    for block, results in blocks.items():
        titles.setdefault(_sentence(results, protocol), []).append(block)
    notes = [f"{'; '.join(of)}: {sentence}" for sentence, of in titles.items()]
    every = [result for results in blocks.values() for result in results]
    for method, length in PUBLISHED_LENGTHS.items():
        if any(result.method == method and result.iterations < length for result in every):
            notes.append(f"{title(method)} is published with {length} iterations.")
    return notes


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
