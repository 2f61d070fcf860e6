"""Checkpoints: a `State` as a folder with tensors in safetensors and values in JSON; no code is ever executed.

`state.json` holds the name, size and SHA-256 of the file of tensors, the identity of the run, and a SHA-256 of itself.
The tensors are written first, under a new name; replacing `state.json` then switches to the new checkpoint. If the
process is killed or the disk is full, the folder still holds one complete checkpoint.
"""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from padgs.files import read_regular, write_atomically
from padgs.training.health import is_out_of_memory
from padgs.training.model import State

FORMAT = 1
MANIFEST = "state.json"
TENSORS = re.compile(r"tensors-[0-9a-f]{16}\.safetensors")
WAY_OUT = "copy it again, use the version of padgs that wrote it, or delete the folder of the run to train anew"


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or is not what was written; the message names the file and the way out."""


def digest(folder: Path) -> str:
    """Return the SHA-256 of the tensors of a checkpoint; if it cannot be read, raise a CheckpointError."""
    return _manifest(folder)["sha256"]


def save(state: State, folder: Path, run: Mapping[str, str] | None = None) -> None:
    """Write a checkpoint of a run with this identity; the previous one stays if that raises a CheckpointError."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in state.tensors.items()}
    content = safetensors.torch.save(tensors)
    digest = hashlib.sha256(content).hexdigest()
    name = f"tensors-{digest[:16]}.safetensors"
    manifest = {"format": FORMAT, "run": dict(run or {}), "tensors": name, "bytes": len(content), "sha256": digest}
    manifest |= {"values": json.loads(json.dumps(state.values, allow_nan=False))}
    text = json.dumps({**manifest, "manifest_sha256": _digest(manifest)}, indent=1).encode()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / name, content)
        write_atomically(folder / MANIFEST, text)
    except OSError as error:
        raise CheckpointError(
            f"cannot write checkpoint {folder}: {error.strerror or error}; the previous one, if any, is complete. "
            "Make room or correct the permissions, then start the run again to resume"
        ) from error
    for stale in folder.glob("tensors-*"):
        if stale.name != name:
            stale.unlink(missing_ok=True)


def load(folder: Path, device: torch.device | str = "cpu", run: Mapping[str, str] | None = None) -> State:
    """Read a checkpoint that `save` wrote, with all tensors on one device; keys of `run` must be those of its identity.

    A CheckpointError says that a file is missing, truncated, changed, of another format, or of another run.
    """
    manifest = _manifest(folder)
    for what, wanted in (run or {}).items():
        if manifest["run"].get(what) != wanted:
            raise CheckpointError(f"{folder} is of a run with another {what}; {WAY_OUT}")
    path = folder / manifest["tensors"]
    try:
        content = read_regular(path)
    except OSError as error:
        raise CheckpointError(f"cannot read {error.filename}: {error.strerror}; {WAY_OUT}") from error
    if len(content) != manifest["bytes"]:
        raise CheckpointError(f"{path} has {len(content)} bytes instead of {manifest['bytes']}; {WAY_OUT}")
    if hashlib.sha256(content).hexdigest() != manifest["sha256"]:
        raise CheckpointError(f"{path} was changed after it was written (SHA-256 differs); {WAY_OUT}")
    with understood(folder):
        # Copies own aligned memory; products of views into the file's bytes may round differently.
        loaded = safetensors.torch.load(content)
        return State({name: tensor.to(device, copy=True) for name, tensor in loaded.items()}, manifest["values"])


@contextmanager
def understood(folder: Path) -> Iterator[None]:
    """Raise a CheckpointError for errors that a state of another method causes; lack of memory is none."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, safetensors.SafetensorError) as error:
        if is_out_of_memory(error):
            raise
        reason = f"{type(error).__name__}: {error}"
        raise CheckpointError(f"{folder} holds no state of this method ({reason}); {WAY_OUT}") from error


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        known = json.loads(read_regular(path))
        if known["format"] != FORMAT:
            newer = isinstance(known["format"], int) and known["format"] > FORMAT
            advice = "resume with a newer padgs" if newer else WAY_OUT
            raise CheckpointError(f"{path} has format {known['format']}, this program reads {FORMAT}; {advice}")
        kinds = {"tensors": str, "bytes": int, "sha256": str, "values": dict, "run": dict, "manifest_sha256": str}
        for key, kind in kinds.items():
            if not isinstance(known[key], kind):
                raise TypeError(f"{key} is no {kind.__name__}")
        if not TENSORS.fullmatch(known["tensors"]):
            raise ValueError(f"{known['tensors']!r} is no file of tensors")
    except OSError as error:
        raise CheckpointError(f"cannot read {error.filename}: {error.strerror}; {WAY_OUT}") from error
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{path} is damaged ({type(error).__name__}: {error}); {WAY_OUT}") from error
    if known.pop("manifest_sha256") != _digest(known):
        raise CheckpointError(f"{path} was changed after it was written (SHA-256 differs); {WAY_OUT}")
    return known


def _digest(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
