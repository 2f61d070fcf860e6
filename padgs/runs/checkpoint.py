"""A `State` as a folder: tensors in safetensors, values in JSON; nothing in it is ever executed.

`state.json` names the file of tensors with its size and SHA-256. The tensors are written first, under a new name, and
replacing `state.json` is the one step that makes the new checkpoint count. So at every moment, whatever is killed or
full, the folder holds one complete checkpoint: the old one or the new one.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from padgs.learning.trainee import State
from padgs.results import replace_file

FORMAT = 1
MANIFEST = "state.json"
WAY_OUT = "delete the checkpoint folder to start this run from the beginning"


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or is not what was written; the message names the file and the way out."""


def exists(folder: Path) -> bool:
    """Whether the folder holds a checkpoint, sound or not."""
    return (folder / MANIFEST).exists()


def digest(folder: Path) -> str:
    """SHA-256 of the tensors of a checkpoint.

    Raises:
        CheckpointError: it cannot be read.
    """
    try:
        return json.loads((folder / MANIFEST).read_bytes())["sha256"]
    except (OSError, ValueError, LookupError) as error:
        raise CheckpointError(f"cannot read {folder / MANIFEST}: {error}; {WAY_OUT}") from error


def save(state: State, folder: Path) -> None:
    """Write a checkpoint, replacing the one in the folder, which stays whole until the new one is.

    Raises:
        CheckpointError: the disk is full, the folder is read-only, ...; the previous checkpoint is untouched.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in state.tensors.items()}
    content = safetensors.torch.save(tensors)
    digest = hashlib.sha256(content).hexdigest()
    name = f"tensors-{digest[:16]}.safetensors"
    manifest = {"format": FORMAT, "tensors": name, "bytes": len(content), "sha256": digest, "values": state.values}
    text = json.dumps(manifest, indent=1, allow_nan=False).encode()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(folder / name, content)
        replace_file(folder / MANIFEST, text)
    except OSError as error:
        raise CheckpointError(
            f"cannot write checkpoint {folder}: {error.strerror or error}; the previous one, if any, is still whole. "
            "Make room or mend the permissions, then start the run again to resume"
        ) from error
    for stale in folder.glob("tensors-*"):
        if stale.name != name:
            stale.unlink(missing_ok=True)


def load(folder: Path, device: torch.device | str = "cpu") -> State:
    """Read a checkpoint that `save` wrote, whole or not at all, all tensors on one device.

    Raises:
        CheckpointError: a file is missing, truncated, changed, or of another format.
    """
    try:
        manifest = _parsed((folder / MANIFEST).read_bytes(), folder / MANIFEST)
        path = folder / manifest["tensors"]
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"cannot read {error.filename}: {error.strerror}; {WAY_OUT}") from error
    if len(content) != manifest["bytes"]:
        raise CheckpointError(f"{path} has {len(content)} bytes instead of {manifest['bytes']}; {WAY_OUT}")
    if hashlib.sha256(content).hexdigest() != manifest["sha256"]:
        raise CheckpointError(f"{path} was changed after it was written (SHA-256 differs); {WAY_OUT}")
    # Clones own aligned memory. Views into the file's bytes would not, and matrix products may round differently then.
    tensors = {name: tensor.to(device, copy=True) for name, tensor in safetensors.torch.load(content).items()}
    return State(tensors, manifest["values"])


def _parsed(manifest: bytes, path: Path) -> dict[str, Any]:
    try:
        known = json.loads(manifest)
        if known["format"] != FORMAT:
            raise CheckpointError(f"{path} has format {known['format']}, this program reads {FORMAT}; {WAY_OUT}")
        return {key: known[key] for key in ("tensors", "bytes", "sha256", "values")}
    except (ValueError, LookupError, TypeError) as error:
        raise CheckpointError(f"{path} is damaged ({type(error).__name__}: {error}); {WAY_OUT}") from error
