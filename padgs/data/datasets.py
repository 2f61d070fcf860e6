"""Published panoramic data sets: their scenes, sources and folders.

Their licences do not allow redistribution. Source: section 4.1 of the PaD-GS paper, and the authors' pages.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from padgs.data.capture import DataError


@dataclass(frozen=True)
class Dataset:
    """A published data set of panoramic scenes."""

    title: str
    folder: str  # of its scenes, within data/
    scenes: tuple[str, ...]
    width: int  # of the paper's evaluation (OmniBlender is not in the paper)
    mask: str  # meaning of data.mask=auto
    source: str  # download
    contents: str  # of a scene's folder


_ROAM360 = (
    "bar", "base", "cafe", "canteen", "center", "center1", "corridor", "innovation", "lab", "library", "office"
)  # fmt: skip
_RICOH360 = (
    "bricks", "bridge", "bridge_under", "cat_tower", "center", "farm", "flower", "gallery_chair", "gallery_park",
    "gallery_pillar", "garden", "poster"
)  # fmt: skip
_OMNIBLENDER = (
    "archiviz-flat", "barbershop", "bistro_bike", "bistro_square", "classroom", "fisher-hut", "lone_monk", "LOU",
    "pavilion_midday_chair", "pavilion_midday_pond", "restroom"
)  # fmt: skip

DATASETS = {
    "roam360": Dataset(
        title="360Roam",
        folder="360roam",
        scenes=_ROAM360,
        width=2048,
        mask="rows:959/1024",
        source="its authors, https://huajianup.github.io/research/360Roam/ (it may not be redistributed)",
        contents="images/, pose_c2w.json and scene.ply",
    ),
    "ricoh360": Dataset(
        title="Ricoh360",
        folder="ricoh360",
        scenes=_RICOH360,
        width=1920,
        mask="none",
        source="the 'Data' link of github.com/changwoonchoi/EgoNeRF",
        contents="imgs/, train.txt, test.txt and output_dir/colmap/",
    ),
    "omniblender": Dataset(
        title="OmniBlender",
        folder="omniblender",
        scenes=_OMNIBLENDER,
        width=2000,
        mask="none",
        source="the 'Data' link of github.com/changwoonchoi/EgoNeRF",
        contents="images/ and transform.json",
    ),
}


def refuse_missing(path: Path, dataset: str | None) -> None:
    """Refuse a missing folder, and say how to get a known data set.

    Raises:
        DataError: `path` does not exist.
    """
    if path.exists():
        return
    likely = [key for key, known in DATASETS.items() if path.name in known.scenes]
    likely.sort(key=lambda key: DATASETS[key].folder != path.parent.name.casefold())  # two data sets have a "center"
    key = dataset or (likely[0] if likely else None)
    if key is None:
        raise DataError(f"{path.absolute()} does not exist; give the folder of panoramas and their poses")
    known = lookup_dataset(key)
    if path.name not in known.scenes:
        raise DataError(
            f"{path.absolute()} does not exist, and {path.name!r} is not a scene of {known.title}; "
            f"its scenes: {', '.join(known.scenes)}"
        )
    what, folder, holds = f"the scene {path.name!r} of {known.title}", path, "this folder holds"
    if not path.parent.exists():  # the same message for all scenes, which a multirun prints once
        what, folder, holds = known.title, path.parent, "the folder of each scene holds"
    raise DataError(
        f"{what} is missing. Get it from {known.source}, and put it into {folder.absolute()}, so that {holds} "
        f"{known.contents}; or set data.path to the folder of a scene"
    )


def lookup_dataset(name: str) -> Dataset:
    """Return the data set of a name.

    Raises:
        DataError: unknown name; the message lists the known ones.
    """
    if name not in DATASETS:
        raise DataError(f"unknown data.dataset {name!r}; known: {', '.join(DATASETS)}")
    return DATASETS[name]
