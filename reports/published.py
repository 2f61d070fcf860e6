"""The numbers of the paper, as data: `baselines/published.csv` holds Tables 1-4 cell by cell."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

PROTOCOL = "paper"  # the only one under which ours may stand beside these
DATASETS = {"roam360": "360roam", "ricoh360": "ricoh360"}  # our names -> theirs
TITLES = {"roam360": "360Roam", "ricoh360": "Ricoh360"}  # of other data sets the scene says enough
SCENES = {"center_1": "center1"}  # the paper's names -> those of the folders, where they differ
MISSING = "missing"


@dataclass(frozen=True)
class Key:
    """Where a published number stands."""

    table: int
    dataset: str
    scene: str
    method: str
    metric: str


@dataclass(frozen=True)
class Published:
    """A published number, or the status that stands in its place."""

    value: float | None
    status: str  # ok, oom, missing


def load(path: Path | None = None) -> Mapping[Key, Published]:
    """All published numbers.

    Raises:
        FileNotFoundError: the file is not where the package ships it.
    """
    with (path or default_path()).open(newline="") as file:
        return {
            Key(
                int(row["table"]), row["dataset"], SCENES.get(row["scene"], row["scene"]), row["method"], row["metric"]
            ): Published(float(row["value"]) if row["value"] else None, row["status"])
            for row in csv.DictReader(file)
        }


def row(numbers: Mapping[Key, Published], table: int, dataset: str, scene: str, method: str) -> dict[str, Published]:
    """Metric -> number, of a method on a scene of a data set, as we call it; empty where the paper has none."""
    where = (table, DATASETS.get(dataset), scene, method)
    return {k.metric: n for k, n in numbers.items() if (k.table, k.dataset, k.scene, k.method) == where}


def scenes(numbers: Mapping[Key, Published], dataset: str) -> list[str]:
    """The folders of the scenes of a data set, as the paper calls it, in the paper's order."""
    found = dict.fromkeys(key.scene for key in numbers if key.dataset == dataset and key.table < 3)
    return [scene for scene in found if scene != "average"]


def scene_title(dataset: str, scene: str) -> str:
    """What a scene is called in a table.

    >>> scene_title("roam360", "bar"), scene_title("", "flat")
    ('360Roam, bar', 'flat')
    """
    return f"{TITLES[dataset]}, {scene}" if dataset in TITLES else scene


def default_path() -> Path:
    """Where the file lies: beside the baselines, in a checkout and in an installed package alike."""
    return Path(__file__).resolve().parent.parent / "baselines" / "published.csv"
