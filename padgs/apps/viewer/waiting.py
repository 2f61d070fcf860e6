"""Waiting for a run to have something to show."""

from __future__ import annotations

import time
from multiprocessing import parent_process
from pathlib import Path

from padgs import results
from padgs.apps.viewer.process import LOOKS, is_wanted
from padgs.runs import checkpoint
from padgs.runs.folder import RunFolder
from padgs.runs.lock import RunBusy, held


def await_checkpoint(folder: str | Path) -> None:
    """Return when a run has its first checkpoint, or can have none any more: opening it then says what is wrong.

    Raises:
        ValueError: it was begun, but nobody trains it.
    """
    files, said, beside = RunFolder(Path(folder)), False, parent_process() is not None

    def decided() -> bool:
        return checkpoint.exists(files.checkpoint) or (files.path / results.FILE_NAME).exists()

    while not decided() and is_wanted():
        if not beside and not (files.path / results.CONFIG_NAME).is_file():
            return
        # Training beside which this process stands may not hold its lock yet; what ended just now is looked at again.
        if not beside and _is_left(files.path) and not decided():
            raise ValueError(f"{folder} has no checkpoint, and nobody trains it; start the same padgs-run again")
        if not said:
            print(f"waiting for the first checkpoint of {folder}  (Ctrl-C ends it)", flush=True)
        said = True
        time.sleep(LOOKS)


def _is_left(folder: Path) -> bool:
    """Whether nobody works on a run, as far as can be told."""
    try:
        with held(folder):
            return True
    except (RunBusy, OSError):  # a folder of somebody else, which cannot be locked from here
        return False
