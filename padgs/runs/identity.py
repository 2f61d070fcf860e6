"""The names of a run: its id, the same exactly where the same numbers must come out, and what no number depends on."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from padgs.results import decisive

HASH_DIGITS = 10


def config_hash(values: Mapping[str, Any]) -> str:
    """SHA-256 of the keys of a resolved configuration that decide something.

    Args:
        values: as `RunConfig.values` gives it, typed, so that 1 and 1.0 of a float field are the same.
    """
    return hashlib.sha256(json.dumps(decisive(values), sort_keys=True).encode()).hexdigest()


def identity(values: Mapping[str, Any], fingerprint: str) -> dict[str, str]:
    """What a checkpoint says of the run that it is of."""
    return {"configuration": config_hash(values), "data set": fingerprint}


def run_id(values: Mapping[str, Any], scene: str, fingerprint: str, preset: str = "") -> str:
    """Scene, preset of the method and variant for people, and a hash of configuration and data for the rest.

    >>> values = {"data": {"path": "/x"}, "method": {"name": "padgs"}, "variant": "no m", "seed": 0}
    >>> run_id(values, "bar", "f00d")
    'bar_padgs_no-m_37d2ecb9bc'
    """
    digest = hashlib.sha256(f"{config_hash(values)}|{fingerprint}".encode()).hexdigest()
    stress = "-".join(map(str, values.get("stress", {}).values()))
    words = [scene, preset or values["method"]["name"], values["variant"], stress]
    readable = [re.sub(r"[^A-Za-z0-9.-]+", "-", word).strip("-.") for word in words]
    return "_".join([*(word for word in readable if word), digest[:HASH_DIGITS]])


@dataclass(frozen=True)
class Labels:
    """Who asked for a run, and by which names; not part of the hash of its configuration."""

    preset: str = ""  # choice of `method`; empty = the method's own name
    experiments: tuple[str, ...] = ()  # experiment and sweep, with "@scale" where it is not full; sorted


def labels(choices: Mapping[str, object]) -> Labels:
    """The labels of a job, from the choices that Hydra composed it of.

    >>> labels({"method": "odgs_release", "experiment": "ablation", "sweep": "seeds", "scale": "cpu"})
    Labels(preset='odgs_release', experiments=('ablation@cpu', 'seeds@cpu'))
    """
    names = [str(choices[group]) for group in ("experiment", "sweep") if choices.get(group)]
    scale = choices.get("scale") or "full"
    suffix = "" if scale == "full" else f"@{scale}"
    return Labels(str(choices.get("method") or ""), tuple(sorted(f"{name}{suffix}" for name in names)))
