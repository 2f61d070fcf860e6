"""Readers of published data sets: 360Roam, Ricoh360, OmniBlender, OB3D and TartanAir-V2.

360Roam: images/, `pose_c2w.json` (world from camera, OpenCV axes; includes the split) and scene.ply. Images of
6080 x 3040 are reduced to the paper's 2048 x 1024 unless data.width is set; the bottom rows (tripod) are masked.

Ricoh360 (EgoNeRF): imgs/, train.txt, test.txt, and COLMAP text files in output_dir/colmap. They were written by OpenMVG
with a camera unknown to COLMAP, so they are parsed here. Their names may differ from the images in extension.

OmniBlender (EgoNeRF): `transform.json`, images/, train.txt, test.txt; no points. Poses are world from camera, with
OpenGL axes, in Blender's z-up world.

OB3D: a folder of one scene and trajectory (Egocentric or Non-Egocentric) with cameras/NNNNN_cam.json (cam from world,
OpenCV axes), images/NNNNN_rgb.png, depths/NNNNN_depth.exr (Blender's depth pass, which is the distance along the ray of
a panoramic camera), sparse/sparse.ply, and the numbers of the views in train.txt and test.txt.

TartanAir-V2, the panoramas of COLMAP's benchmark: images/, depth/ (steps of 1/8 metre along the ray, the least of 4x4
pixels, 0 = unknown), and poses.txt with a line "frame x y z qx qy qz qw" each: world (x north, y east, z down) from a
body that looks along x. The middle of a panorama shows the left of the body. There are no points and no split.
"""

from pathlib import Path

import torch

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, DataError, DataOptions, DepthMeaning, Frame, first_of
from padgs.data.cloud import first_ply, forgiving
from padgs.data.datasets import DATASETS
from padgs.data.formats import poses
from padgs.data.formats.colmap import pose_of
from padgs.data.formats.colmap_files import read_images, read_points
from padgs.data.formats.json_file import Json, file_in, read_json
from padgs.data.splits import LISTS, check_name, read_lines, read_list

# Body axes (x ahead, y right, z down) of TartanAir's camera axes x, y and z: its panoramas are turned by 90 degrees.
_BODY_FROM_CAMERA = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)


def read_roam360(path: Path, options: DataOptions) -> Capture:
    """Read poses, split and points of a 360Roam scene."""
    file = file_in(path, "pose_c2w.json")
    data = read_json(file)
    images = image_folder(path, options.images)
    frames: list[Frame] = []
    split: dict[str, tuple[str, ...]] = {}
    for side in ("train", "test"):
        for item in data[side].entries():
            name = item["rgb_file"].name()
            matrix = Json(item.value, f"{name} in {file}")["transform_matrix"]
            frames.append(Frame(name, images / name, poses.cam_from_pose(matrix.numbers(), matrix.where)))
        split[side] = tuple(item["rgb_file"].name() for item in data[side].entries())
    if twice := set(split["train"]) & set(split["test"]):
        raise DataError(f"{file}: {min(twice)} is both a train and a test view; keep it in one list")
    known = DATASETS["roam360"]
    cloud = first_ply(path, ("scene.ply", f"{path.name}.ply", "pcd.ply"), options.points)
    return Capture("roam360", path, images, tuple(frames), cloud, split, known.mask, known.width)


def read_ricoh360(path: Path, options: DataOptions) -> Capture:
    """Read poses and points of a Ricoh360 scene."""
    images = image_folder(path, options.images, ("imgs", "images"))
    mask, model = first_of(images, ("mask.png",)), path / "output_dir" / "colmap"
    file = model / "images.txt"
    frames = []
    for image in read_images(file):
        name = check_name(image.name, str(file))
        pose = pose_of(image, f"{name} in {file}")
        frames.append(Frame(name, images / name, pose, mask=mask))
    cloud = first_ply(path, ("openMVG/scene.ply", "scene.ply", "pcd.ply"), options.points)
    if cloud is None and (model / "points3D.txt").is_file():
        with forgiving(options.points):
            cloud = read_points(model / "points3D.txt")[1]
    return Capture("ricoh360", path, images, tuple(frames), cloud)


def read_omniblender(path: Path, options: DataOptions) -> Capture:
    """Read `transform.json` of an OmniBlender scene."""
    file = file_in(path, "transform.json")
    meta = read_json(file)
    images = image_folder(file.parent, options.images)
    width, height = (side and side.whole() for side in (meta.get("width"), meta.get("height")))
    frames = []
    for item in meta["frames"].entries():
        name = item["file_path"].name()
        matrix = Json(item.value, f"{name} in {file}")["transform_matrix"]
        pose = poses.cam_from_opengl_pose(matrix.numbers(), matrix.where)
        frames.append(Frame(name, images / name, pose, width, height))
    names = ("pcd.ply", "scene.ply", "openMVG/scene.ply", "openMVG/reconstruction/colorized.ply")
    return Capture("omniblender", file.parent, images, tuple(frames), first_ply(file.parent, names, options.points))


def read_ob3d(path: Path, options: DataOptions) -> Capture:
    """Read the cameras, depth maps and lists of one trajectory of an OB3D scene."""
    images = image_folder(path, options.images)
    frames: dict[str, Frame] = {}  # by number
    for file in sorted((path / "cameras").glob("[!.]*_cam.json")):
        cameras = read_json(file).entries()
        if len(cameras) != 1:
            raise DataError(f"{file} must hold a list of one camera; copy it again")
        camera, number = cameras[0], file.name.removesuffix("_cam.json")
        stated, name = camera["extrinsics"], f"{number}_rgb.png"
        pose = poses.cam_from_world(stated["rotation"].numbers(3, 3), stated["translation"].numbers(3), str(file))
        depth = path / "depths" / f"{number}_depth.exr" if (path / "depths").is_dir() else None
        size = camera["width"].whole(), camera["height"].whole()
        frames[number] = Frame(name, images / name, pose, *size, depth=depth)
    if not frames:
        raise DataError(f"{path / 'cameras'} holds no NNNNN_cam.json; give the folder Egocentric or Non-Egocentric")
    split = {}
    for side, name in LISTS.items():
        if listing := first_of(path, (name,)):
            lines = read_list(listing)
            split[side] = tuple(f"{line.zfill(5)}_rgb.png" if line.isdecimal() else line for line in lines)
    depth, cloud = DepthMeaning("ray", 1.0, "OB3D"), first_ply(path, ("sparse/sparse.ply",), options.points)
    name = "_".join(path.absolute().parts[-2:])
    return Capture("ob3d", path, images, tuple(frames.values()), cloud, split or None, depth=depth, name=name)


def read_tartanair(path: Path, options: DataOptions) -> Capture:
    """Read poses and depth maps of a scene of TartanAir-V2, as COLMAP packs it."""
    images, file = image_folder(path, options.images), file_in(path, "poses.txt")
    frames = []
    for index, line in enumerate(read_lines(file), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        where = f"line {index} of {file}"
        try:
            frame, *numbers = line.split()
            name, values = f"{int(frame):06d}", torch.tensor(list(map(float, numbers)), dtype=torch.float64)
        except ValueError as error:
            raise DataError(f"{where} is {line[:60]!r}; it must be: frame x y z qx qy qz qw") from error
        if len(values) != 7:
            raise DataError(f"{where} has {len(values)} numbers after the frame; it must have 7: x y z qx qy qz qw")
        body = poses.rotation_from_quaternion(values[[6, 3, 4, 5]], where)
        pose = poses.cam_from_pose(poses.rigid(body @ _BODY_FROM_CAMERA, values[:3]), where)
        depth = path / "depth" / f"{name}.png"
        jpeg, png = images / f"{name}.jpg", images / f"{name}.png"
        image = png if png.is_file() and not jpeg.is_file() else jpeg
        frames.append(Frame(image.name, image, pose, depth=depth if depth.parent.is_dir() else None))
    return Capture("tartanair", path, images, tuple(frames), None, depth=DepthMeaning("ray", 1 / 8, "TartanAir-V2"))
