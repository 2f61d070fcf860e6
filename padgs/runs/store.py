"""The files of one run, its lock and its identity.

A run folder holds config.yaml, log.jsonl, checkpoint/, renders/, and result.json, which is written last. A file `stop`
in it requests that training ends early and is scored.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unicodedata import normalize

import torch
from filelock import FileLock, Timeout
from omegaconf import OmegaConf
from PIL import Image
from torch import Tensor

from padgs import results
from padgs.checks import ConfigError
from padgs.evaluation.images import comparison_image
from padgs.files import write_atomically
from padgs.results import Result, decisive
from padgs.runs import checkpoint
from padgs.scene import Scene, View
from padgs.training.loop import Record
from padgs.training.method import Method
from padgs.training.model import State

if TYPE_CHECKING:
    from padgs.runs.config import RunConfig

PROGRESS = "progress"  # key of `Progress` in a checkpoint
LONGEST_WORD, LONGEST_BYTES = 48, 90  # letters and bytes of a scene or variant in the name of a folder, of 255 bytes
LOCK, OWNER = ".lock", ".owner.json"


class RunFolderError(RuntimeError):
    """The run folder cannot be written; the message names the file, the reason and the way out."""


class RunBusy(RuntimeError):
    """Another process works on this run; the message says which."""


@dataclass(frozen=True)
class Progress:
    """Progress of training."""

    iteration: int = 0
    seconds: float = 0.0  # training time
    cpu_seconds: float = 0.0
    share: float = 0.0  # of the schedule
    peak_memory_bytes: int = 0  # of all processes that trained; see `Result`
    peak_device_memory_bytes: int | None = None
    made_by: tuple[str, str] = ("", "")  # code and hardware of all processes that trained


class RunStore:
    """Files of one run, locked while it is a context manager; RunFolderError if a file cannot be written."""

    def __init__(self, path: Path, run: Mapping[str, str] | None = None) -> None:
        """Open a run folder; `run` is the `identity` that its checkpoint must have, None for any."""
        self.path, self._run = path, run
        self.checkpoint, self.config = path / "checkpoint", path / results.CONFIG_NAME
        self.renders = path / results.PICTURES
        self.stop = path / "stop"
        self._log = path / results.LOG_NAME
        self._lock = FileLock(path / LOCK)

    @classmethod
    def of(cls, config: RunConfig, scene: Scene) -> RunStore:
        """Return the store of a run."""
        values = config.values()
        name = run_id(values, scene.name, scene.fingerprint, config.preset)
        return cls(Path(config.run.folder) / name, identity(values, scene.fingerprint))

    def __enter__(self) -> RunStore:
        """Make the folder and lock it without waiting; raise RunBusy if another process holds the lock.

        The kernel's lock on an open file is free as soon as its process dies. On file systems without such locks,
        `filelock` falls back to the existence of the file and takes over from dead processes of this host.
        """
        owner = self.path / OWNER
        with self._writing():
            self.path.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire(timeout=0)
            except Timeout as error:
                raise RunBusy(f"{self.path} is being worked on by {self._owner()}; it is left alone") from error
            try:
                owner.write_text(json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "since": _now()}))
            except OSError:
                self._lock.release()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            (self.path / OWNER).unlink()
        self._lock.release()

    @property
    def is_busy(self) -> bool:
        """True if another process holds the lock, or the folder cannot be locked from here."""
        try:
            self._lock.acquire(timeout=0)
        except OSError as error:  # a `Timeout`, or a folder that cannot be locked from here
            return isinstance(error, Timeout) or (self.path / OWNER).exists()
        self._lock.release()
        return False

    @property
    def has_checkpoint(self) -> bool:
        """True if there is a checkpoint, even a damaged one."""
        return (self.checkpoint / checkpoint.MANIFEST).exists()

    @property
    def has_result(self) -> bool:
        """True if the run has ended with a result."""
        return (self.path / results.FILE_NAME).exists()

    def prepare(self, values: Mapping[str, Any]) -> None:
        """Make the folder and write config.yaml."""
        with self._writing():
            self.renders.mkdir(parents=True, exist_ok=True)
            write_atomically(self.config, OmegaConf.to_yaml(OmegaConf.create(dict(values))).encode())

    def result(self) -> Result | None:
        """Return the result if the run is finished; a damaged file raises a ResultError."""
        return results.read(self.path / results.FILE_NAME) if self.has_result else None

    def finish(self, result: Result) -> Result:
        """Write result.json, which finishes the run; return the result as later readers see it."""
        with self._writing():
            path = results.write(replace(result, finished=result.finished or _now()), self.path)
            self.stop.unlink(missing_ok=True)  # it would stop the next start
        return results.read(path)

    def forget(self, result: Result) -> None:
        """Let a failed run start again; after oom, from its checkpoint."""
        with self._writing():
            if result.status != "oom":
                shutil.rmtree(self.checkpoint, ignore_errors=True)
            self.stop.unlink(missing_ok=True)
            (self.path / results.FILE_NAME).unlink()

    def log(self, record: Record, probed: Mapping[str, float]) -> None:
        """Append a line to log.jsonl; `probed` holds the metrics of the held-out view, empty if not measured."""
        line: dict[str, Any] = {"iteration": record.iteration, "progress": round(record.progress, 6)}
        line |= {"seconds": round(record.seconds, 4), **record.counts, **probed}
        line |= {"loss": record.loss} if isinstance(record.loss, float) else {}  # others wait for a GPU, untimed
        if record.events:
            line["events"] = list(record.events)
        with self._writing(), self._log.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def save(self, method: Method, progress: Progress) -> None:
        """Write the checkpoint; if that raises a CheckpointError, the previous one stands."""
        state = method.state()
        checkpoint.save(State(state.tensors, {**state.values, PROGRESS: asdict(progress)}), self.checkpoint, self._run)

    def resume(self, method: Method, device: torch.device | str = "cpu") -> Progress:
        """Load the checkpoint into a method and return its progress, that of a new run without one.

        Log lines of later iterations are dropped, as those iterations come again; so is a line cut by a kill.
        """
        progress = Progress()
        if self.has_checkpoint:
            state = checkpoint.load(self.checkpoint, device, self._run)
            with checkpoint.understood(self.checkpoint):
                method.load_state(state)
                progress = Progress(**state.values[PROGRESS])
        if self._log.exists():
            kept = [line for line in results.log_lines(self.path) if line["iteration"] <= progress.iteration]
            with self._writing():
                write_atomically(self._log, "".join(json.dumps(line) + "\n" for line in kept).encode())
        return progress

    def save_image(self, view: View, truth: Tensor, image: Tensor) -> None:
        """Save ground truth | render | error of a view side by side; images [H, W, 3]."""
        with self._writing():
            Image.fromarray(comparison_image(truth, image)).save(self.renders / results.picture_name(view.name))

    def _owner(self) -> str:
        try:
            owner: dict[str, Any] = json.loads((self.path / OWNER).read_text())
            return f"process {owner['pid']} on {owner['host']} since {owner['since']}"
        except (OSError, ValueError, KeyError, TypeError):
            return "another process"

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise cannot_write(self.path, error) from error


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def cannot_write(path: Path, error: OSError) -> RunFolderError:
    """Return the error to raise if a run folder or a file beside it cannot be written."""
    return RunFolderError(
        f"cannot write run folder {path}: {error.strerror or error}; "
        "make room, correct the permissions, or name another place (run.folder; padgs score: --to)"
    )


def config_hash(values: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the keys of `RunConfig.values()` that numbers depend on."""
    return hashlib.sha256(json.dumps(decisive(values), sort_keys=True).encode()).hexdigest()


def identity(values: Mapping[str, Any], fingerprint: str) -> dict[str, str]:
    """Return the identity of a run, which its checkpoint states."""
    return {"configuration": config_hash(values), "data set": fingerprint}


def run_id(values: Mapping[str, Any], scene: str, fingerprint: str, preset: str = "") -> str:
    """Return the name of a run: scene, preset and variant, and a hash of configuration and data.

    Two runs have the same id exactly if they must produce the same numbers.

    >>> values = {"data": {"path": "/x"}, "method": {"name": "padgs"}, "variant": "no m", "seed": 0}
    >>> run_id(values, "bar", "f00d")
    'bar_padgs_no-m_37d2ecb9bc'
    >>> run_id(values, "客厅 1", "f00d")
    '客厅-1_padgs_no-m_37d2ecb9bc'
    """
    digest = hashlib.sha256(f"{config_hash(values)}|{fingerprint}".encode()).hexdigest()
    stress = "-".join(map(str, values.get("stress", {}).values()))
    words = [scene, preset or values["method"]["name"], values["variant"], stress]
    readable = [re.sub(r"(?:[^\w.-]|_)+", "-", normalize("NFC", word))[:LONGEST_WORD] for word in words]
    short = [word.encode()[:LONGEST_BYTES].decode(errors="ignore").strip("-.") for word in readable]
    return "_".join([*filter(None, short), digest[:10]])


@dataclass(frozen=True)
class Labels:
    """Names under which a run was requested; not part of its configuration hash."""

    preset: str = ""  # choice of `method`; empty = the method's own name
    experiments: tuple[str, ...] = ()  # experiment and sweep, with "@scale" unless the scale is full; sorted


def labels(choices: Mapping[str, object]) -> Labels:
    """Return the labels of a job, from the choices that Hydra composed it of.

    >>> labels({"method": "odgs_release", "experiment": "ablation", "sweep": "seeds", "scale": "cpu"})
    Labels(preset='odgs_release', experiments=('ablation@cpu', 'seeds@cpu'))

    A ConfigError says that a configuration file has a name that no result may have.
    """
    names = [str(choices[group]) for group in ("experiment", "sweep") if choices.get(group)]
    scale = choices.get("scale") or "full"
    suffix = "" if scale == "full" else f"@{scale}"
    made = Labels(str(choices.get("method") or ""), tuple(sorted(f"{name}{suffix}" for name in names)))
    if odd := [name for name in (made.preset, *made.experiments) if name and not results.PLAIN.fullmatch(name)]:
        raise ConfigError(
            f"{odd[0]!r} cannot be the name of results; call its file by letters, digits, _ . - alone, in no subfolder"
        )
    return made
