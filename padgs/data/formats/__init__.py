"""Readers and writers of data set formats: one `read(path, options) -> Capture` each. `detect` chooses."""

from fnmatch import fnmatch
from pathlib import Path

from padgs.data.capture import OTHERS, DataError, first_of, listed
from padgs.data.formats.colmap import find_model
from padgs.data.formats.metashape import find_xml, xml_files

E57 = "*.[eE]57"
# Files that together identify a format, most specific first: folders of published data sets also hold files of general
# formats. No files: a COLMAP model.
SIGNS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("roam360", ("pose_c2w.json",)),
    ("ricoh360", ("output_dir/colmap/images.txt",)),
    ("released", ("data_extrinsics.json", "data_views.json")),
    ("ob3d", ("cameras/[!.]*_cam.json",)),
    ("tartanair", ("poses.txt", "scene.json")),
    ("colmap", ()),
    ("omniblender", ("transform.json",)),
    ("transforms", ("transforms.json",)),
    ("transforms", ("transforms_train.json",)),
    ("openmvg", ("sfm_data.json",)),
    ("opensfm", ("reconstruction.json",)),
    ("metashape", ("*.xml",)),
    ("navvis", ("pano-poses.csv",)),
    ("navvis", ("pano/pano-poses.csv",)),
    ("e57", (E57,)),
)
NEARLY = {  # names of files that hold a data set in another form, and what to do with them
    ("sfm_data*",): "make sfm_data.json of it with openMVG_main_ConvertSfM_DataFormat -V -I -E -S",
    ("reconstruction*.json", "transforms*.json"): "call it reconstruction.json or transforms.json",
    ("*.psx", "*.psz"): "open it in Metashape, and export cameras.xml (File > Export > Export Cameras)",
    ("*.zip", "*.tar*", "*.tgz", "*.7z", "*.rar"): "unpack it, and give its folder",
}
SEARCHED = 50  # folders on each level below one without a format, which are tried instead of it
# Files that may be given instead of their folder.
ALONE = ("transform.json", "transforms.json", "sfm_data.json", "reconstruction.json", "*.xml", "pano-poses.csv", E57)


def detect(path: Path) -> tuple[str, str]:
    """Detect the format of a data set; return its name and the reason. A DataError lists what identifies a format."""
    if not (found := _found(path)):
        names = [child.name for child in sorted(path.iterdir())] if path.is_dir() else []
        inside = listed(names) if path.is_dir() else "a file"
        above = [str(parent) for parent in list(path.absolute().parents)[2::-1] if _found(parent)][:1]
        levels = (sorted(filter(Path.is_dir, path.glob(level)))[:SEARCHED] for level in ("*", "*/*"))
        inner = [folder for folders in levels for folder in folders if _found(folder) and find_model(folder) != folder]
        near = [*map(str, [*inner, *xml_files(path)]), *above]
        hint = f", but {listed(near)} {'has: give that' if len(near) == 1 else 'have: give one'}" if near else ""
        for ends, way in NEARLY.items():
            others = [name for name in [path.name, *names] if any(fnmatch(name.lower(), end) for end in ends)]
            hint += f", but {others[0]}: {way}" if others else ""
        raise DataError(
            f"{path} has no known format{hint}; it holds {inside or 'nothing'}. Known: a COLMAP model (sparse/0), "
            "transforms.json, sfm_data.json, reconstruction.json, cameras.xml (Metashape), pano-poses.csv (NavVis), "
            "an .e57 file, pose_c2w.json (360Roam), output_dir/colmap (Ricoh360), transform.json (OmniBlender), "
            "cameras/*_cam.json (OB3D), poses.txt with scene.json (TartanAir-V2), "
            "data_views.json with data_extrinsics.json. Panoramas without poses: run `padgs prepare IMAGES OUT` first"
        )
    name, *others = found
    if name == "navvis":  # whose points may be in an E57 file
        others = [other for other in others if other != "e57"]
    reason = f"format: {name}, detected by {found[name]}"
    if others:
        reason += f" ({OTHERS}: {', '.join(found[other] for other in others)}; set data.format to choose)"
    return name, reason


def _found(path: Path) -> dict[str, str]:
    """Return the formats that a folder or file may have, and what identifies each."""
    found: dict[str, str] = {}
    for format, files in SIGNS:
        if not files and path.is_dir() and (model := find_model(path)):
            found[format] = f"the COLMAP model in {model.relative_to(path)}"
        elif path.is_file() and files and files[0] in ALONE and fnmatch(path.name.lower(), files[0]):
            found[format] = path.name
        elif format == "metashape":
            if path.is_dir() and (xml := find_xml(path)):
                found[format] = xml.name
        elif files and all(there := [first_of(path, (f,)) or next(iter(sorted(path.glob(f))), None) for f in files]):
            found.setdefault(format, " and ".join(file.relative_to(path).as_posix() for file in there if file))
    return found
