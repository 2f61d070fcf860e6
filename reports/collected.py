"""What is worth committing of finished runs: result files as they are, and the probes of their logs. No pictures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from padgs.results import FILE_NAME, Result
from reports import quality_log


def files(folder: Path, results: Sequence[Result]) -> Iterator[tuple[str, bytes]]:
    """Path relative to the new folder of runs, and content, for each run."""
    found = quality_log.probes(folder, results)
    for result in results:
        yield f"{result.run}/{FILE_NAME}", (folder / result.run / FILE_NAME).read_bytes()
        lines = [
            {"iteration": probe.iteration, "seconds": probe.seconds, "psnr": probe.psnr}
            for probe in found.get(result.run, ())
        ]
        if lines:
            yield f"{result.run}/{quality_log.FILE_NAME}", "".join(f"{json.dumps(line)}\n" for line in lines).encode()
