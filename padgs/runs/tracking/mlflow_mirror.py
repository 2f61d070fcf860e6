"""Contents of a run folder in mlflow: settings, progress in batches, marks, pictures and tables."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas
from omegaconf import OmegaConf

from padgs import results
from padgs.reports.frame import frame
from padgs.reports.selection import Request, RunSet
from padgs.reports.store import Run
from padgs.reports.writers import csv_text, markdown
from padgs.results import Result

RUN, PARENT, MULTIRUN, LOGGED = "padgs.run", "mlflow.parentRunId", "padgs.multirun", "padgs.logged_iteration"  # tags
MOST_PARAMS, MOST_METRICS = 100, 1000  # in one batch, as mlflow's servers allow
LONGEST_VALUE = 500  # characters


class Mirror:
    """Writes run folders into one experiment."""

    def __init__(self, client: Any, experiment: str, multirun: str = "") -> None:
        """Find or create the parent run of a multirun (no parent if `multirun` is empty) in the experiment of an id."""
        self._client, self._experiment = client, experiment
        self._parent = (self._find(MULTIRUN, multirun) or self._create(MULTIRUN, multirun)) if multirun else ""

    def update(self, run: Path) -> None:
        """Log what is new in a run folder, finished or in progress."""
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

    def finish(self, found: Sequence[Result], jobs: int) -> None:
        """End the parent run of a multirun, with a table of all its results."""
        if self._parent:
            self._log_table(self._parent, found)
            ended = "KILLED" if len(found) < jobs else "FINISHED" if all(result.ok for result in found) else "FAILED"
            self._client.set_terminated(self._parent, ended)

    def _find(self, tag: str, value: str) -> str | None:
        """Return the id of the latest mlflow run with a tag."""
        found = self._client.search_runs([self._experiment], f"tags.`{tag}` = '{value}'", max_results=1)
        return found[0].info.run_id if found else None

    def _create(self, tag: str, name: str, more: Mapping[str, str] | None = None) -> str:
        return self._client.create_run(self._experiment, run_name=name, tags={tag: name, **(more or {})}).info.run_id

    def _log_settings(self, identity: str, run: Path) -> None:
        from mlflow.entities import Param

        config: Any = OmegaConf.to_container(OmegaConf.load(run / results.CONFIG_NAME))
        (flat,) = pandas.json_normalize(config).to_dict("records")  # with dotted keys
        params = [Param(str(key), str(value)[:LONGEST_VALUE]) for key, value in flat.items()]
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
        now = int(1000 * time.time())
        metrics = [Metric(key, value, now, result.iterations_done) for key, value in final_numbers(result).items()]
        tags = [RunTag(f"padgs.{key}", value[:LONGEST_VALUE]) for key, value in words.items()]
        self._client.log_batch(identity, metrics=metrics, tags=tags)
        self._client.log_artifacts(identity, str(run / results.PICTURES), results.PICTURES)
        self._client.log_artifact(identity, str(run / results.FILE_NAME))
        self._log_table(identity, [result])
        self._client.set_terminated(identity, "FINISHED" if result.ok else "FAILED")

    def _log_table(self, identity: str, found: Sequence[Result]) -> None:
        table = RunSet(frame(map(Run, found)), Request(mix=True)).report("runs")
        self._client.log_text(identity, markdown(table), "tables/runs.md")
        self._client.log_text(identity, csv_text(table), "tables/runs.csv")


def final_numbers(result: Result) -> dict[str, float]:
    """Return metrics under each protocol, times and sizes, without missing values."""
    numbers = {
        f"{name}/{metric}": value
        for name, scores in result.scores.items()
        for metric, value in scores.metrics.items()
        if value is not None
    }
    numbers |= {f"time/{key}": value for key, value in result.timing.items()}
    numbers |= {f"size/{key}": float(value) for key, value in result.counts.items()}
    if result.peak_device_memory_bytes is not None:
        numbers["peak_device_memory_bytes"] = result.peak_device_memory_bytes
    return numbers | {"size/model_bytes": float(result.model_bytes), "peak_memory_bytes": result.peak_memory_bytes}


def batches(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    """Yield consecutive parts of at most `size` items."""
    for start in range(0, len(items), size):
        yield items[start : start + size]
