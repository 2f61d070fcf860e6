"""What a run is called in tables: names of files in `conf/` and `sweeps/` that no number depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

FULL = "full"  # the scale that is not mentioned


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
    scale = choices.get("scale") or FULL
    names = [str(choices[group]) for group in ("experiment", "sweep") if choices.get(group)]
    suffix = "" if scale == FULL else f"@{scale}"
    return Labels(str(choices.get("method") or ""), tuple(sorted(f"{name}{suffix}" for name in names)))
