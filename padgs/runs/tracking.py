"""Mirror run folders into mlflow. Errors of mlflow never end a run: run folders are only read.

Only the process that the user started mirrors the runs of a multirun. mlflow takes seconds to import and to create its
database, so it is imported when the first run is mirrored, after training has begun.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock
from omegaconf import OmegaConf

from padgs import results
from padgs.checks import check_known, install_command
from padgs.results import Result

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
RUN, PARENT, MULTIRUN, LOGGED = "padgs.run", "mlflow.parentRunId", "padgs.multirun", "padgs.logged_iteration"  # tags
MOST_PARAMS, MOST_METRICS = 100, 1000  # in one batch, as mlflow's servers allow
LONGEST_VALUE = 500  # characters


@dataclass(frozen=True)
class TrackingOptions:
    """The `tracking` group of the configuration; it does not affect the run id."""

    kind: str = "auto"  # auto | mlflow | none; auto: mlflow if it is installed
    uri: str | None = None  # of a server or database; None = mlflow.db in run.folder
    telemetry: bool = False  # whether mlflow may report its use to its makers

    def __post_init__(self) -> None:
        check_known(self, kind=KINDS)


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
        self._uri = options.uri or f"sqlite:///{self._runs / 'mlflow.db'}"
        self._say, self._multirun = say, multirun
        self._client: Any = None
        self.on = options.kind != "none"
        if self.on and importlib.util.find_spec("mlflow") is None:
            self.on = False
            if options.kind == "mlflow" or options.uri is not None:
                say(f"runs are not mirrored into mlflow: {install_command('mlflow')}, or set tracking=none")

    def update(self, run: Path) -> None:
        """Log what is new in a run folder, finished or in progress."""
        self._attempt(lambda: self._update(run))

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
        if not self._options.telemetry:
            os.environ["MLFLOW_DISABLE_TELEMETRY"] = os.environ["DO_NOT_TRACK"] = "true"
        from mlflow import MlflowClient

        with FileLock(self._runs / ".mlflow.lock", timeout=PATIENCE):  # two processes creating one database destroy it
            client = MlflowClient(self._uri)
            known = client.get_experiment_by_name(self.name)
            # Beside a database, artifacts would be written into the working folder.
            place = None if self._uri.startswith(SERVERS) else (self._runs / "mlflow-artifacts").as_uri()
            self._experiment = known.experiment_id if known else client.create_experiment(self.name, place)
            self._client, name = client, self._multirun
            self._parent = (self._find(MULTIRUN, name) or self._create(MULTIRUN, name)) if name else ""

    def _update(self, run: Path) -> None:
        result = results.read(run / results.FILE_NAME) if (run / results.FILE_NAME).exists() else None
        identity = self._find(RUN, run.name)
        has_failed = identity and self._client.get_run(identity).info.status == "FAILED"
        if not identity or (has_failed and (result is None or result.ok)):  # restarted: keep the failed attempt apart
            identity = self._create(RUN, run.name, {PARENT: self._parent} if self._parent else {})
            self._log_settings(identity, run)
        self._log_progress(identity, run)
        if result:
            self._log_result(identity, run, result)
        else:
            self._client.update_run(identity, status="RUNNING")

    def _find(self, tag: str, value: str) -> str | None:
        """Return the id of the latest mlflow run with a tag."""
        found = self._client.search_runs([self._experiment], f"tags.`{tag}` = '{value}'", max_results=1)
        return found[0].info.run_id if found else None

    def _create(self, tag: str, name: str, more: Mapping[str, str] | None = None) -> str:
        return self._client.create_run(self._experiment, run_name=name, tags={tag: name, **(more or {})}).info.run_id

    def _log_settings(self, identity: str, run: Path) -> None:
        from mlflow.entities import Param

        config: Any = OmegaConf.to_container(OmegaConf.load(run / results.CONFIG_NAME))
        params = [Param(key, str(value)[:LONGEST_VALUE]) for key, value in flat(config)]
        for batch in batches(params, MOST_PARAMS):
            self._client.log_batch(identity, params=batch)

    def _log_progress(self, identity: str, run: Path) -> None:
        """Send lines of log.jsonl that mlflow does not have; iterations repeated after a resume are sent once."""
        from mlflow.entities import Metric, RunTag

        known = int(self._client.get_run(identity).data.tags.get(LOGGED, 0))
        now, metrics, last = int(1000 * time.time()), [], known
        for line in results.log_lines(run):
            if line["iteration"] > known:
                last = line["iteration"]
                numbers = {key: value for key, value in line.items() if isinstance(value, (int, float))}
                metrics += [Metric(f"train/{key}", float(value), now, last) for key, value in numbers.items()]
        for batch in batches(metrics, MOST_METRICS):
            self._client.log_batch(identity, metrics=batch)
        self._client.log_batch(identity, tags=[RunTag(LOGGED, str(last))])

    def _log_result(self, identity: str, run: Path, result: Result) -> None:
        from mlflow.entities import Metric, RunTag

        words = {"status": result.status, "preset": result.preset, "scene": result.scene, "variant": result.variant}
        words |= {"experiments": " ".join(result.experiments), "reason": result.reason}
        numbers: dict[str, Any] = {name: scores.metrics for name, scores in result.scores.items()}
        numbers |= {"time": result.timing, "size": {**result.counts, "model_bytes": result.model_bytes}}
        numbers |= {name: getattr(result, name) for name in ("peak_memory_bytes", "peak_device_memory_bytes")}
        now = int(1000 * time.time())
        known = [(key.replace(".", "/"), value) for key, value in flat(numbers) if value is not None]
        metrics = [Metric(key, float(value), now, result.iterations_done) for key, value in known]
        tags = [RunTag(f"padgs.{key}", value[:LONGEST_VALUE]) for key, value in words.items()]
        self._client.log_batch(identity, metrics=metrics, tags=tags)
        self._client.log_artifacts(identity, str(run / results.PICTURES), results.PICTURES)
        self._client.log_artifact(identity, str(run / results.FILE_NAME))
        self._client.set_terminated(identity, "FINISHED" if result.ok else "FAILED")


def flat(values: Mapping[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted key and value of nested mappings.

    >>> dict(flat({"seed": 1, "data": {"width": 64}}))
    {'seed': 1, 'data.width': 64}
    """
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{where}{key}.")
        else:
            yield f"{where}{key}", value


def batches(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    """Yield consecutive parts of at most `size` items."""
    for start in range(0, len(items), size):
        yield items[start : start + size]
