"""Files that take their place once they are complete: where writing is cut off, the earlier one stays as it was."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A hidden place beside `path`, of the same ending, to write to: it becomes `path` at the end, or nothing is left.

    Raises:
        OSError: it was not written, or cannot take the place.
    """
    draft = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        yield draft
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
