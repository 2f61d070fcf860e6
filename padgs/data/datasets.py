"""Published panoramic data sets of datasets.yaml: their scenes, sources and folders."""

import os
from dataclasses import dataclass
from pathlib import Path

import yaml

from padgs.data.capture import DataError, listed


@dataclass(frozen=True)
class Dataset:
    """A published data set of panoramic scenes."""

    title: str
    folder: str  # of its scenes, within data/
    scenes: tuple[str, ...]
    width: int  # of the paper's evaluation, or as stored (of those that are not in the paper)
    mask: str  # meaning of data.mask=auto
    source: str  # download
    contents: str  # of a scene's folder
    nested: bool = False  # whether the scene a_b is in the folder a/b

    def place(self, scene: str) -> str:
        """Return the folder of a scene within that of the data set."""
        return scene.replace("_", "/") if self.nested else scene

    def scene_at(self, path: Path) -> str | None:
        """Return the scene whose folder the path names, None if it names no scene of this data set."""
        end = "/".join(path.parts[-2:]) if self.nested else path.name
        return next((scene for scene in self.scenes if self.place(scene) == end), None)


def _read() -> dict[str, Dataset]:
    """Return the data sets of datasets.yaml; a category begins the names of its scenes."""
    found = {}
    text = Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
    for key, known in yaml.safe_load(text).items():
        scenes = known["scenes"]
        groups = {"": scenes} if isinstance(scenes, str) else {f"{category}_": s for category, s in scenes.items()}
        names = tuple(f"{start}{scene}" for start, words in groups.items() for scene in words.split())
        found[key] = Dataset(**known | {"scenes": names})
    return found


DATASETS = _read()


def refuse_missing(path: Path, dataset: str | None) -> None:
    """Refuse a missing folder, and say how to get a known data set."""
    if os.path.exists(path):  # False behind a closed folder
        return
    likely = [key for key, known in DATASETS.items() if known.scene_at(path)]
    likely.sort(key=lambda key: DATASETS[key].folder != path.parent.name.casefold())  # two data sets have a "center"
    key = dataset or (likely[0] if likely else None)
    if key is None:
        raise DataError(f"{path.absolute()} does not exist; give the folder of panoramas and their poses")
    known = lookup_dataset(key)
    if (scene := known.scene_at(path)) is None:
        raise DataError(
            f"{path.absolute()} does not exist, and {path.name!r} is not a scene of {known.title}; "
            f"its scenes: {listed(map(known.place, known.scenes), most=30)}"
        )
    what, folder, holds = f"the scene {scene!r} of {known.title}", path, "this folder holds"
    top = path.parents[known.nested]
    if not os.path.exists(top):  # the same message for all scenes, which a multirun prints once
        what, folder, holds = known.title, top, "the folder of each scene holds"
    raise DataError(
        f"{what} is missing. Get it from {known.source}, and put it into {folder.absolute()}, so that {holds} "
        f"{known.contents}; or set data.path to the folder of a scene"
    )


def lookup_dataset(name: str) -> Dataset:
    """Return the data set of a name; a DataError lists the known ones."""
    if name not in DATASETS:
        raise DataError(f"unknown data.dataset {name!r}; known: {', '.join(DATASETS)}")
    return DATASETS[name]
