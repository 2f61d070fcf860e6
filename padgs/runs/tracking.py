"""Mirror finished runs into mlflow. Errors of mlflow never end a run: run folders are only read.

Only the process that the user started mirrors the runs of a multirun. mlflow takes seconds to import and to create its
database, so it is imported when the first run has ended.
"""

import importlib.util
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock

from padgs import results
from padgs.checks import check_known, install_command
from padgs.results import Result

SERVERS = ("http", "databricks")  # beginnings of their URIs
PATIENCE = 60.0  # seconds to wait for another process that creates the database
SETTINGS = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",  # by default, a server that does not answer holds a run up for minutes
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
}
RUN, PARENT, MULTIRUN, FINISHED = "padgs.run", "mlflow.parentRunId", "padgs.multirun", "padgs.finished"  # tags
MOST_PARAMS, MOST_METRICS = 100, 1000  # in one batch, as mlflow's servers allow
LONGEST_VALUE = 500  # characters


@dataclass(frozen=True)
class TrackingOptions:
    """The `tracking` group of the configuration; it does not affect the run id."""

    kind: str = "auto"  # auto | mlflow | none; auto: mlflow if it is installed
    uri: str | None = None  # URI of a server or database; None = mlflow.db in run.folder

    def __post_init__(self) -> None:
        check_known(self, kind=("auto", "mlflow", "none"))


class Tracker:
    """Mirrors the finished runs of one experiment into mlflow, or says once why it does not."""

    def __init__(
        self, options: TrackingOptions, runs: Path, experiment: str, say: Callable[[str], None], multirun: str = ""
    ) -> None:
        """Import and connect nothing yet.

        `experiment` and `multirun` (empty: none) are names in mlflow; `say` shows a line to the user, at most once.
        """
        self._runs, self.name = runs.absolute(), experiment or "padgs"
        self._uri = options.uri or f"sqlite:///{self._runs / 'mlflow.db'}"
        self._say, self._multirun = say, multirun
        self._client: Any = None
        self.on = options.kind != "none"
        if self.on and importlib.util.find_spec("mlflow") is None:
            self.on = False
            if options.kind == "mlflow" or options.uri is not None:
                say(f"runs are not mirrored into mlflow: {install_command('mlflow')}, or set tracking=none")

    def add(self, run: Path) -> None:
        """Mirror a run folder with a result, unless this very result is mirrored."""
        self._attempt(lambda: self._add(run, results.read(run / results.FILE_NAME)))

    def finish(self, statuses: Sequence[str], jobs: int) -> None:
        """End the parent run of a multirun of so many jobs, of which those with results have these statuses."""
        ended = "KILLED" if len(statuses) < jobs else "FINISHED" if {*statuses} <= {"ok"} else "FAILED"
        self._attempt(lambda: self._parent and self._client.set_terminated(self._parent, ended))

    def _attempt(self, work: Callable[[], object]) -> None:
        if not self.on:
            return
        try:
            if self._client is None:
                self._connect()
            work()
        except Exception as error:  # of any kind: mlflow, its database and its server are foreign
            self.on = False
            reason = f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0][:200]}"
            self._say(f"no longer mirrored into mlflow at {self._uri} ({reason}); `padgs track` does it later")

    def _connect(self) -> None:
        """Find or create the experiment, and in it the parent run of a multirun."""
        for name, value in SETTINGS.items():
            os.environ.setdefault(name, value)
        from mlflow import MlflowClient

        with FileLock(self._runs / ".mlflow.lock", timeout=PATIENCE):  # two processes creating one database destroy it
            client = MlflowClient(self._uri)
            known = client.get_experiment_by_name(self.name)
            # Beside a database, artifacts would be written into the working folder.
            place = None if self._uri.startswith(SERVERS) else (self._runs / "mlflow-artifacts").as_uri()
            self._experiment = known.experiment_id if known else client.create_experiment(self.name, place)
            self._client, name = client, self._multirun
            self._parent = (self._find(MULTIRUN, name) or self._create(name, {MULTIRUN: name})) if name else ""

    def _find(self, tag: str, value: str) -> str | None:
        """Return the id of the latest mlflow run with a tag."""
        found = self._client.search_runs([self._experiment], f"tags.`{tag}` = '{value}'", max_results=1)
        return found[0].info.run_id if found else None

    def _create(self, name: str, tags: Mapping[str, str]) -> str:
        return self._client.create_run(self._experiment, run_name=name, tags=tags).info.run_id

    def _add(self, run: Path, result: Result) -> None:
        from mlflow.entities import Metric, Param

        mark = f"{result.run} {results.encoded(result)['sha256']}"  # of copies and renamed folders, too
        if self._find(FINISHED, mark):
            return
        words = {"status": result.status, "preset": result.preset, "scene": result.scene, "variant": result.variant}
        words |= {"experiments": " ".join(result.experiments), "reason": result.reason}
        tags = {f"padgs.{key}": value[:LONGEST_VALUE] for key, value in words.items()}
        tags |= {RUN: result.run} | ({PARENT: self._parent} if self._parent else {})
        identity = self._create(result.run, tags)
        params = [Param(key, str(value)[:LONGEST_VALUE]) for key, value in results.flat(result.config)]
        for start in range(0, len(params), MOST_PARAMS):
            self._client.log_batch(identity, params=params[start : start + MOST_PARAMS])
        now = int(1000 * time.time())
        metrics = [
            Metric(f"train/{key}", float(value), now, line["iteration"])
            for line in results.log_lines(run)
            for key, value in line.items()
            if isinstance(value, (int, float))
        ]
        numbers: dict[str, Any] = {name: scores.metrics for name, scores in result.scores.items()}
        numbers |= {"time": result.timing, "size": {**result.counts, "model_bytes": result.model_bytes}}
        numbers |= {name: getattr(result, name) for name in ("peak_memory_bytes", "peak_device_memory_bytes")}
        metrics += [
            Metric(key.replace(".", "/"), float(value), now, result.iterations_done)
            for key, value in results.flat(numbers)
            if value is not None
        ]
        for start in range(0, len(metrics), MOST_METRICS):
            self._client.log_batch(identity, metrics=metrics[start : start + MOST_METRICS])
        self._client.log_artifacts(identity, str(run / results.PICTURES), results.PICTURES)
        self._client.log_artifact(identity, str(run / results.FILE_NAME))
        self._client.set_terminated(identity, "FINISHED" if result.ok else "FAILED")
        self._client.set_tag(identity, FINISHED, mark)
