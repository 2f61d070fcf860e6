"""What lies in the folder of a run besides its result: names, and its log."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

LOG_NAME, CONFIG_NAME = "log.jsonl", "config.yaml"
PICTURES = "renders"  # folder of truth | render | error of each test view, in one picture
NEED_PICTURE = "need.png"  # truth | whole model | smallest for each of `NEED_PICTURED`, of a test view


def log_lines(run_folder: Path, tail: int | None = None) -> Iterator[dict[str, Any]]:
    """The whole lines of a run's log, each with its `iteration`; a line that is being written, or was cut, is left out.

    Args:
        run_folder: of one run; a log that is missing has no lines.
        tail: read so many bytes at the end of the log only.
    """
    try:
        with (run_folder / LOG_NAME).open("rb") as file:
            if tail is not None:
                file.seek(max(0, file.seek(0, os.SEEK_END) - tail))
            lines = file.read().splitlines()
    except OSError:
        return
    for line in lines:
        try:
            entry = json.loads(line)
            entry["iteration"] = int(entry["iteration"])
        except (ValueError, KeyError, TypeError):
            continue
        yield entry


def file_name(text: str) -> str:
    """A text as the name of a file, which leads nowhere else.

    >>> file_name("left/R001 a"), file_name("chart_../../etc")
    ('left-R001-a', 'chart_..-..-etc')
    """
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text)


def picture_name(view: str) -> str:
    """The name of the file with the picture of a test view, among the `renders` of a run.

    >>> picture_name("left/R001 a")
    'left-R001-a.png'
    """
    return file_name(view) + ".png"
