"""Mirror run folders into mlflow. Errors of mlflow never end a run: run folders are only read.

Only the process that the user started mirrors the runs of a multirun. mlflow takes seconds to import and to create its
database, so it is imported when the first run is mirrored, after training has begun.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock

from padgs.checks import check_known, install_command
from padgs.results import Result

if TYPE_CHECKING:
    from padgs.runs.tracking.mlflow_mirror import Mirror

KINDS = ("auto", "mlflow", "none")
DEFAULT_EXPERIMENT = "padgs"  # of mlflow, for runs without an experiment
SERVERS = ("http", "databricks")  # beginnings of their URIs
SECONDS_BETWEEN_LOOKS = 30.0  # between updates of a run in progress
PATIENCE = 60.0  # seconds to wait for another process that creates the database
SETTINGS = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",  # by default, a server that does not answer holds a run up for minutes
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
}


@dataclass(frozen=True)
class TrackingOptions:
    """The `tracking` group of the configuration; it does not affect the run id."""

    kind: str = "auto"  # auto | mlflow | none; auto: mlflow if it is installed
    uri: str | None = None  # of a server or database; None = mlflow.db in run.folder
    telemetry: bool = False  # whether mlflow may report its use to its makers

    def __post_init__(self) -> None:
        check_known(self, kind=KINDS)

    @property
    def is_requested(self) -> bool:
        """True if tracking was requested explicitly, so that a missing mlflow is reported."""
        return self.kind == "mlflow" or (self.kind == "auto" and self.uri is not None)


class Tracker:
    """Mirrors the runs of one experiment into mlflow, or says once why it does not."""

    def __init__(
        self, options: TrackingOptions, runs: Path, experiment: str, say: Callable[[str], None], multirun: str = ""
    ) -> None:
        """Import and connect nothing yet.

        Args:
            options: the server or database.
            runs: the folder of run folders.
            experiment: of mlflow; empty = DEFAULT_EXPERIMENT.
            say: shows a line to the user; called at most once.
            multirun: name of the parent run in mlflow; empty = none.
        """
        self._options, self._runs, self.name = options, runs.absolute(), experiment or DEFAULT_EXPERIMENT
        self._say, self._multirun = say, multirun
        self._mirror: Mirror | None = None
        self.on = options.kind != "none"
        if self.on and importlib.util.find_spec("mlflow") is None:
            self.on = False
            if options.is_requested:
                say(f"runs are not mirrored into mlflow: {install_command('mlflow')}, or set tracking=none")

    @property
    def uri(self) -> str:
        """Return the address that runs are mirrored to, independent of the working folder."""
        return self._options.uri or f"sqlite:///{self._runs / 'mlflow.db'}"

    def update(self, run: Path) -> None:
        """Log what is new in a run folder, finished or in progress."""
        self._attempt(lambda mirror: mirror.update(run))

    def finish(self, found: Sequence[Result], jobs: int) -> None:
        """End the parent run of a multirun of so many jobs, with a table of all its results."""
        self._attempt(lambda mirror: mirror.finish(found, jobs))

    def _attempt(self, work: Callable[[Mirror], None]) -> None:
        if not self.on:
            return
        try:
            if self._mirror is None:
                self._mirror = self._connected()
            work(self._mirror)
        except Exception as error:  # of any kind: mlflow, its database and its server are foreign
            self.on = False
            reason = f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0][:200]}"
            self._say(f"no longer mirrored into mlflow at {self.uri} ({reason}); `padgs track` does it later")

    def _connected(self) -> Mirror:
        for name, value in SETTINGS.items():
            os.environ.setdefault(name, value)
        if not self._options.telemetry:
            os.environ["MLFLOW_DISABLE_TELEMETRY"] = os.environ["DO_NOT_TRACK"] = "true"
        from mlflow import MlflowClient

        from padgs.runs.tracking.mlflow_mirror import Mirror

        with FileLock(self._runs / ".mlflow.lock", timeout=PATIENCE):  # two processes creating one database destroy it
            client = MlflowClient(self.uri)
            known = client.get_experiment_by_name(self.name)
            # Beside a database, artifacts would be written into the working folder.
            place = None if self.uri.startswith(SERVERS) else (self._runs / "mlflow-artifacts").as_uri()
            identity = known.experiment_id if known else client.create_experiment(self.name, place)
            return Mirror(client, identity, self._multirun)
