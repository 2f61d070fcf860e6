"""What a run tells whoever started it, and what it asks."""

from __future__ import annotations

from pathlib import Path


class Watch:
    """Listens to nothing and never stops a run; subclasses do."""

    def started(self, folder: Path, iterations: int) -> None:
        """The run has this folder, and goes to so many iterations."""

    def saved(self, folder: Path) -> None:
        """A checkpoint was written, and the log is up to date."""

    def stop_requested(self) -> bool:
        """Whether the run should write its checkpoint and stop."""
        return False
