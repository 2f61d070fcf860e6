"""The hidden folder that a preparation works in, and that an interrupted one goes on in."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from padgs.data.prepare import resources


class WorkFolder:
    """Steps that are done once in a folder, each with a marker, `STEP.done`.

    Attributes:
        path: of the folder.
        seconds: name of a step -> what it took in this process.
    """

    def __init__(self, path: Path) -> None:
        """Of a folder that need not be there yet."""
        self.path, self.seconds = path, dict[str, float]()

    def open(self, of: str, digest: str, keep: tuple[str, ...] = ()) -> None:
        """Go on with what is there of the same digest; start over, but for `keep`, with any other."""
        marker = self.path / f"{of}.sha256"
        if not (marker.is_file() and marker.read_text() == digest):
            for path in self.path.iterdir() if self.path.is_dir() else ():
                if path.name not in keep:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
        self.path.mkdir(parents=True, exist_ok=True)
        marker.write_text(digest)

    def empty(self, name: str) -> Path:
        """A folder within it, with nothing in that."""
        folder = self.path / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        return folder

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Note how long a step takes."""
        start = time.perf_counter()
        yield
        self.seconds[name] = round(time.perf_counter() - start, 2)

    def once(self, step: str, action: Callable[[], None]) -> None:
        """Do a step unless it has been done in this folder.

        Raises:
            DataError: the disk is full.
        """
        marker = self.path / f"{step}.done"
        with self.step(step):
            if not marker.exists():
                resources.refuse_full(self.path)
                action()
                marker.touch()
