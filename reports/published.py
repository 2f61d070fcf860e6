"""Numbers of the paper's Tables 1-4 (`baselines/published.csv`), and the scenes that tables are about."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import yaml

from padgs.reports.table import Cell

FILE = Path(__file__).resolve().parent.parent / "baselines" / "published.csv"  # in a checkout and when installed
PROTOCOL = "paper"  # the only protocol under which ours may stand beside published numbers
DATASETS = {"roam360": "360roam", "ricoh360": "ricoh360"}  # our names -> names in the file
TITLES = {"roam360": "360Roam", "ricoh360": "Ricoh360"}
SCENES = {"center_1": "center1"}  # names in the file -> names of the folders, where they differ
AVERAGE = "average"
BUILT_IN = "synthetic"  # data set of the generated scenes; their names begin with it
NOT_TUNED_ON, TUNED_ON = "not tuned on", "tuned on"
_KNOWN = yaml.safe_load((FILE.parent.parent / "conf" / "tuned_on.yaml").read_text("utf-8"))
SAME_DATA = {other: first for first, others in _KNOWN.pop("same").items() for other in others}  # of fingerprints
SEEN = {  # beginning of the fingerprint of a capture, or name of a generated scene -> NOT_TUNED_ON or TUNED_ON
    data: kind.replace("_", " ") for kind, scenes in _KNOWN.items() for known in scenes.values() for data in known
}
OUTDOOR = {"outdoor", "garden", "plaza", "courtyard", "park", "street"}  # words of names; all others are for Table 1


class Key(NamedTuple):
    """Position of a published number."""

    table: int
    dataset: str
    scene: str
    method: str
    metric: str


@dataclass(frozen=True)
class Place:
    """A scene of a data set, as results name them."""

    dataset: str
    scene: str
    apart: str = ""  # condition that separates its runs from others of the scene
    seen: str = ""  # NOT_TUNED_ON, TUNED_ON, or nothing where it is not known whether settings were chosen on it

    @classmethod
    def of(cls, dataset: str, scene: str, fingerprint: str) -> Place:
        """Return the scene of a result.

        >>> Place.of("", "room", "e7acbfd00cf5").seen, Place.of("", "room", "0123456789").seen  # a room of someone else
        ('tuned on', '')
        """
        data = SAME_DATA.get(fingerprint[:10], fingerprint[:10])
        return cls(dataset, scene, seen=SEEN.get(scene if dataset == BUILT_IN else data, ""))

    @property
    def published(self) -> bool:
        """True if the paper has numbers of the data set."""
        return self.dataset in DATASETS

    @property
    def outdoor(self) -> bool:
        """True if the scene belongs beside the outdoor scenes of Ricoh360.

        >>> Place("", "city_park-2").outdoor, Place("", "parking").outdoor
        (True, False)
        """
        return self.dataset == "ricoh360" or not OUTDOOR.isdisjoint(re.split(r"[\W_]+", self.scene.lower()))

    @property
    def label(self) -> str:
        """Name of the scene, and the condition that separates its runs."""
        return ", ".join(filter(None, (self.scene, self.apart)))

    @property
    def heading(self) -> str:
        """Title without origin.

        >>> Place("roam360", "bar").heading, Place("", "flat").heading
        ('360Roam, bar', 'flat')
        """
        return f"{TITLES[self.dataset]}, {self.label}" if self.published else self.label

    @property
    def title(self) -> str:
        """Title with the data set, and whether the methods' settings were chosen on the scene."""
        origin = "" if self.published else "generated" if self.dataset == BUILT_IN else self.dataset
        words = ", ".join(filter(None, (origin, self.seen)))
        return f"{self.heading} ({words})" if words else self.heading

    @property
    def stem(self) -> str:
        """Unique label for file names: with the data set, unless the name of the scene says it.

        >>> Place("", "room").stem, Place("omniblender", "room").stem, Place("synthetic", "synthetic-room").stem
        ('room', 'room_omniblender', 'synthetic-room')
        """
        implied = BUILT_IN if self.scene.startswith(f"{BUILT_IN}-") else ""
        return self.label if self.dataset == implied else f"{self.label}_{self.dataset or 'capture'}"

    @property
    def rank(self) -> tuple[int, int, str, str, str]:
        """Sort key: scenes of the paper first, then those not tuned on, then by name, and those tuned on last."""
        order, seen = list(DATASETS), (NOT_TUNED_ON, "", TUNED_ON).index(self.seen)
        first = order.index(self.dataset) if self.published else len(order)
        return first, seen, self.dataset, self.scene, self.apart


def load() -> Mapping[Key, Cell]:
    """Return all published numbers; a FileNotFoundError says that the file is missing from the package."""
    with FILE.open(newline="") as file:
        rows = [{**row, "scene": SCENES.get(row["scene"], row["scene"])} for row in csv.DictReader(file)]
    keys = (Key(int(of["table"]), of["dataset"], of["scene"], of["method"], of["metric"]) for of in rows)
    values = ((of["value"], of["status"].removeprefix("missing")) for of in rows)
    cells = (Cell(float(value), count=0) if value else Cell(status=status) for value, status in values)
    return dict(zip(keys, cells, strict=True))


def row(numbers: Mapping[Key, Cell], table: int, place: Place, method: str) -> dict[str, Cell]:
    """Return metric -> number of a method on a scene; empty where the paper has none."""
    where = (table, DATASETS.get(place.dataset), place.scene, method)
    return {k.metric: n for k, n in numbers.items() if (k.table, k.dataset, k.scene, k.method) == where}


def mean_row(numbers: Mapping[Key, Cell], table: int, places: list[Place], method: str) -> dict[str, Cell]:
    """Return metric -> mean of a method over some scenes of a data set, where the paper has a number for each."""
    dataset = places[0].dataset
    if {place.scene for place in places} == {*scenes(numbers, DATASETS[dataset])}:
        return row(numbers, table, Place(dataset, AVERAGE), method)
    rows = [row(numbers, table, place, method) for place in places]
    known = [{name: number.value for name, number in own.items() if number.value is not None} for own in rows]
    shared = set.intersection(*map(set, known))
    return {name: Cell(sum(own[name] for own in known) / len(known), count=0) for name in shared}


def scenes(numbers: Mapping[Key, Cell], dataset: str) -> list[str]:
    """Return the folder names of a data set's scenes, in the paper's order; `dataset` as the paper calls it."""
    found = dict.fromkeys(key.scene for key in numbers if key.dataset == dataset and key.table < 3)
    return [scene for scene in found if scene != AVERAGE]
