"""Published panoramic data sets: their scenes, sources and folders.

Their licences do not allow redistribution. Source: section 4.1 of the PaD-GS paper, and the authors' pages.
"""

from dataclasses import dataclass
from pathlib import Path

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
_OB3D = (
    "archiviz-flat", "barbershop", "bistro", "classroom", "emerald-square", "fisher-hut", "lone-monk", "pavillion",
    "restroom", "san-miguel", "sponza", "sun-temple"
)  # fmt: skip
_TARTANAIR = {  # category: environment-difficulty-trajectory
    "infrastructure": """
        AbandonedCable-easy-P002 AbandonedCable-hard-P003 AbandonedFactory-easy-P000 AbandonedFactory2-easy-P000
        AbandonedSchool-easy-P001 CarWelding-easy-P005 CarWelding-hard-P000 CoalMine-hard-P001
        ConstructionSite-easy-P009 FactoryWeather-easy-P011 FactoryWeather-hard-P012 Hospital-easy-P008
        Hospital-hard-P000 IndustrialHangar-hard-P005 OldIndustrialCity-easy-P008 Prison-hard-P006
        Sewerage-easy-P008 Sewerage-hard-P010""",
    "domestic": """
        AmericanDiner-hard-P002 ArchVizTinyHouseDay-easy-P006 ArchVizTinyHouseDay-hard-P003
        ArchVizTinyHouseNight-easy-P006 CountryHouse-hard-P004 House-easy-P000 Office-easy-P005 Office-hard-P006
        OldBrickHouseDay-hard-P003 OldBrickHouseNight-easy-P004 Restaurant-easy-P008 Restaurant-hard-P005
        RetroOffice-hard-P005 Supermarket-easy-P000 Supermarket-hard-P004""",
    "rural": """
        AmusementPark-easy-P003 AncientTowns-easy-P000 AncientTowns-hard-P005 CastleFortress-easy-P007
        CastleFortress-hard-P008 DesertGasStation-hard-P001 EndofTheWorld-easy-P004 Fantasy-hard-P004
        GothicIsland-easy-P006 GreatMarsh-easy-P001 GreatMarsh-hard-P003 HQWesternSaloon-hard-P004
        SeasideTown-easy-P006 SoulCity-easy-P007 SoulCity-hard-P003 WaterMillDay-easy-P006 WaterMillDay-hard-P004
        WaterMillNight-hard-P006 WesternDesertTown-easy-P004 WesternDesertTown-hard-P006""",
    "thematic": """
        Antiquity3D-hard-P006 Apocalyptic-easy-P002 CyberPunkDowntown-easy-P006 CyberPunkDowntown-hard-P000
        Cyberpunk-hard-P006 PolarSciFi-easy-P006 PolarSciFi-hard-P005 Rome-easy-P005 Slaughter-hard-P001""",
    "nature": """
        BrushifyMoon-hard-P004 ForestEnv-easy-P002 ForestEnv-hard-P000 Gascola-easy-P003 Ocean-easy-P003
        Ocean-hard-P001 OldScandinavia-easy-P005 OldScandinavia-hard-P004 Ruins-easy-P008 Ruins-hard-P000
        SeasonalForestAutumn-hard-P000 SeasonalForestSpring-easy-P001 SeasonalForestSummerNight-hard-P001
        SeasonalForestWinter-easy-P002 SeasonalForestWinterNight-easy-P001 SeasonalForestWinterNight-hard-P002
        ShoreCaves-hard-P003 TerrainBlending-easy-P003""",
    "urban": """
        Downtown-easy-P008 HongKong-easy-P001 HongKong-hard-P004 JapaneseAlley-easy-P000 JapaneseAlley-hard-P005
        JapaneseCity-hard-P005 MiddleEast-easy-P005 ModUrbanCity-hard-P005 ModernCityDowntown-easy-P006
        ModularNeighborhood-hard-P010 ModularNeighborhoodIntExt-easy-P007 ModularNeighborhoodIntExt-hard-P001
        NordicHarbor-easy-P006 OldTownFall-hard-P001 OldTownNight-easy-P002 OldTownNight-hard-P000
        OldTownSummer-easy-P000 OldTownWinter-hard-P001 UrbanConstruction-easy-P000 VictorianStreet-hard-P000""",
}

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
    "ob3d": Dataset(
        title="OB3D",
        folder="ob3d",
        scenes=tuple(f"{scene}_{path}" for scene in _OB3D for path in ("Egocentric", "Non-Egocentric")),
        width=1600,
        mask="none",
        source="https://www.kaggle.com/datasets/shintacs/ob3d-dataset (arXiv 2505.20126)",
        contents="cameras/, images/, depths/, sparse/sparse.ply, train.txt and test.txt",
        nested=True,
    ),
    "tartanair": Dataset(
        title="TartanAir-V2",
        folder="tartanair",
        scenes=tuple(f"{category}_{scene}" for category, text in _TARTANAIR.items() for scene in text.split()),
        width=2048,
        mask="none",
        source="https://github.com/colmap/colmap/releases/tag/datasets-tartanair-v2-v1 (CC BY 4.0)",
        contents="images/, depth/, poses.txt and scene.json",
        nested=True,
    ),
}


def refuse_missing(path: Path, dataset: str | None) -> None:
    """Refuse a missing folder, and say how to get a known data set.

    Raises:
        DataError: `path` does not exist.
    """
    if path.exists():
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
    if not top.exists():  # the same message for all scenes, which a multirun prints once
        what, folder, holds = known.title, top, "the folder of each scene holds"
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
