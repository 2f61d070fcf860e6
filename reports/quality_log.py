"""The held-out PSNR that a run measured while it was training, from its `log.jsonl`."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from padgs.results import Result

FILE_NAME = "log.jsonl"


@dataclass(frozen=True)
class Probe:
    """One measurement."""

    iteration: int
    seconds: float  # of training so far
    psnr: float  # dB


def probes(folder: Path, results: Iterable[Result]) -> dict[str, list[Probe]]:
    """Run -> its measurements, for each run that left a log in its folder."""
    found = {}
    for result in results:
        try:
            lines = (folder / result.run / FILE_NAME).read_text().splitlines()
        except OSError:
            continue  # result files are enough for all else
        found[result.run] = read(lines)
    return found


def read(lines: Iterable[str]) -> list[Probe]:
    """The measurements in the lines of a log; a line that a kill has cut says nothing.

    >>> read(['{"iteration": 9, "seconds": 1.5, "psnr": 20.0}', '{"iteration": 10, "seconds": 1.6}', '{"iter'])
    [Probe(iteration=9, seconds=1.5, psnr=20.0)]
    """
    found = []
    for line in lines:
        if '"psnr"' not in line:
            continue
        try:
            record = json.loads(line)
            found.append(Probe(int(record["iteration"]), float(record["seconds"]), float(record["psnr"])))
        except (ValueError, KeyError, TypeError):
            continue
    return found
