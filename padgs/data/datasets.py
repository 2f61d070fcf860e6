"""The public panoramic data sets: what is in them, where they come from, and where to put them.

None of them may be redistributed with the project. Facts: the paper's section 4.1 and the authors' pages.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from padgs.data.capture import DataError


@dataclass(frozen=True)
class Dataset:
    """A published set of panoramic scenes."""

    title: str
    scenes: tuple[str, ...]
    width: int  # at which the paper reports (OmniBlender is not in the paper)
    mask: str  # what data.mask=auto means
    source: str  # where to get it
    holds: str  # what the folder of a scene must hold


DATASETS = {
    "roam360": Dataset(
        title="360Roam",
        scenes=(
            "bar",
            "base",
            "cafe",
            "canteen",
            "center",
            "center1",
            "corridor",
            "innovation",
            "lab",
            "library",
            "office",
        ),
        width=2048,
        mask="rows:959/1024",
        source="its authors, https://huajianup.github.io/research/360Roam/ (it may not be redistributed)",
        holds="images/, pose_c2w.json and scene.ply",
    ),
    "ricoh360": Dataset(
        title="Ricoh360",
        scenes=(
            "bricks",
            "bridge",
            "bridge_under",
            "cat_tower",
            "center",
            "farm",
            "flower",
            "gallery_chair",
            "gallery_park",
            "gallery_pillar",
            "garden",
            "poster",
        ),
        width=1920,
        mask="none",
        source="the 'Data' link of github.com/changwoonchoi/EgoNeRF",
        holds="imgs/, train.txt, test.txt and output_dir/colmap/",
    ),
    "omniblender": Dataset(
        title="OmniBlender",
        scenes=(
            "archiviz-flat",
            "barbershop",
            "bistro_bike",
            "bistro_square",
            "classroom",
            "fisher-hut",
            "lone_monk",
            "LOU",
            "pavilion_midday_chair",
            "pavilion_midday_pond",
            "restroom",
        ),
        width=2000,
        mask="none",
        source="the 'Data' link of github.com/changwoonchoi/EgoNeRF",
        holds="images/ and transform.json",
    ),
}


def refuse_missing(path: Path, dataset: str | None) -> None:
    """Raise if a data set's folder is not there, and say how to get it if it is a known one.

    Raises:
        DataError: always, unless `path` exists.
    """
    if path.exists():
        return
    likely = [key for key, known in DATASETS.items() if path.name in known.scenes]
    likely.sort(key=lambda key: DATASETS[key].title.casefold() != path.parent.name.casefold())  # "center" is in two
    key = dataset or (likely[0] if likely else None)
    if key is None:
        raise DataError(f"there is no {path.absolute()}; give the folder of panoramas and their poses")
    known = lookup_dataset(key)
    if path.name not in known.scenes:
        raise DataError(
            f"there is no {path.absolute()}, and {path.name!r} is no scene of {known.title}; "
            f"its scenes: {', '.join(known.scenes)}"
        )
    if not path.parent.exists():  # the same words for all scenes, which a multirun says once
        raise DataError(
            f"{known.title} is not there. Get it from {known.source}, and put it into {path.parent.absolute()}, so "
            f"that the folder of each scene holds {known.holds}; or set data.path to a scene where it is"
        )
    raise DataError(
        f"the scene {path.name!r} of {known.title} is not there. Get it from {known.source}, and put it into "
        f"{path.absolute()}, so that this folder holds {known.holds}; or set data.path to where it is"
    )


def lookup_dataset(name: str) -> Dataset:
    """The data set of that name.

    Raises:
        DataError: unknown; the message lists the known ones.
    """
    if name not in DATASETS:
        raise DataError(f"unknown data.dataset {name!r}; known: {', '.join(DATASETS)}")
    return DATASETS[name]
