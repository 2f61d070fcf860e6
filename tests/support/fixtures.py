"""A tiny world with exact poses, written in every format that padgs reads.

Nothing here uses padgs: images are ray-cast, and files follow the formats' own documentation, so that errors of readers
are not repeated. The world is a coloured box without symmetries; cameras inside are tilted, which reveals wrong axes.
"""

import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

HALF = np.array([2.0, 1.2, 1.6])  # of the box, world units
OPENGL = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class World:
    """Ground truth of the tiny world."""

    names: tuple[str, ...]  # without extension
    images: tuple[NDArray[np.uint8], ...]  # [H, W, 3]
    rotations: NDArray[np.float64]  # [F, 3, 3] cam_from_world; x right, y down, z forward
    centers: NDArray[np.float64]  # [F, 3] world
    points: NDArray[np.float64]  # [P, 3] on the box
    colors: NDArray[np.uint8]  # [P, 3]
    test: tuple[str, ...]

    @property
    def translations(self) -> NDArray[np.float64]:
        return -np.einsum("fij,fj->fi", self.rotations, self.centers)

    @property
    def train(self) -> tuple[str, ...]:
        return tuple(name for name in self.names if name not in self.test)

    @property
    def size(self) -> tuple[int, int]:
        return self.images[0].shape[1], self.images[0].shape[0]

    def world_from_cam(self, i: int, axes: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return the pose [4, 4] of frame i for a camera whose axes are `axes` times those of OpenCV."""
        pose = np.eye(4)
        pose[:3, :3] = self.rotations[i].T @ (np.eye(3) if axes is None else axes)
        pose[:3, 3] = self.centers[i]
        return pose


def make_world(count: int = 6, width: int = 64, points: int = 400, seed: int = 7) -> World:
    source = np.random.default_rng(seed)
    rotations = Rotation.from_quat([np.roll(source.normal(size=4), -1) for _ in range(count)]).as_matrix()
    centers = source.uniform(-0.5, 0.5, (count, 3)) * HALF
    images = tuple(_panorama(rotations[i], centers[i], width) for i in range(count))
    cloud = source.normal(size=(points, 3))
    cloud = _exit(np.zeros(3), cloud / np.linalg.norm(cloud, axis=1, keepdims=True))
    names = tuple(f"pano_{i:02d}" for i in range(count))
    return World(names, images, rotations, centers, cloud, paint(cloud), (names[1], names[4]))


def write_images(world: World, folder: Path, extension: str = "png") -> None:
    folder.mkdir(parents=True)
    for name, image in zip(world.names, world.images, strict=True):
        options = {"quality": 100, "subsampling": 0} if extension == "jpg" else {}
        Image.fromarray(image).save(folder / f"{name}.{extension}", **options)


def write_lists(world: World, folder: Path, extension: str = "") -> None:
    (folder / "train.txt").write_text("".join(f"{name}{extension}\n" for name in world.train))
    (folder / "test.txt").write_text("".join(f"{name}{extension}\n" for name in world.test))


def write_cloud(world: World, path: Path) -> None:
    """Write an ASCII PLY."""
    header = ["ply", "format ascii 1.0", f"element vertex {len(world.points)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    rows = [
        " ".join([*(repr(float(x)) for x in point), *(str(int(c)) for c in color)])
        for point, color in zip(world.points, world.colors, strict=True)
    ]
    path.write_text("\n".join([*header, "end_header", *rows]) + "\n")


def write_colmap_text(world: World, folder: Path, camera: str = "EQUIRECTANGULAR") -> None:
    write_images(world, folder / "images")
    write_lists(world, folder, ".png")
    _colmap_text(world, folder / "sparse" / "0", camera)


def write_colmap_binary(world: World, folder: Path, rigs: bool = True) -> None:
    """Write a model of COLMAP 4 (`rigs`) or 3. Every point has a track over all frames."""
    write_images(world, folder / "images")
    write_lists(world, folder, ".png")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    width, height = world.size
    count = len(world.names)
    (model / "cameras.bin").write_bytes(struct.pack("<QIiQQdd", 1, 1, 17, width, height, width, height))
    images, points = [struct.pack("<Q", count)], [struct.pack("<Q", len(world.points))]
    for i, name in enumerate(world.names):
        seen = _project(world.points, world.rotations[i], world.centers[i], width)
        pose = struct.pack("<7d", *quaternion(world.rotations[i]), *world.translations[i])
        images.append(struct.pack("<I", i + 1) + pose + struct.pack("<I", 1) + f"{name}.png".encode() + b"\0")
        images.append(struct.pack("<Q", len(seen)))
        images += [struct.pack("<ddQ", u, v, k + 1) for k, (u, v) in enumerate(seen)]
    for k, (point, color) in enumerate(zip(world.points, world.colors, strict=True)):
        points.append(struct.pack("<Q3d3BdQ", k + 1, *point, *(int(c) for c in color), 0.1, count))
        points += [struct.pack("<II", i + 1, k) for i in range(count)]
    (model / "images.bin").write_bytes(b"".join(images))
    (model / "points3D.bin").write_bytes(b"".join(points))
    if not rigs:
        return
    (model / "rigs.bin").write_bytes(struct.pack("<QIIiI", 1, 1, 1, 0, 1))
    frames = [struct.pack("<Q", count)]
    for i in range(count):
        pose = struct.pack("<7d", *quaternion(world.rotations[i]), *world.translations[i])
        frames.append(struct.pack("<II", i + 1, 1) + pose + struct.pack("<IiIQ", 1, 0, 1, i + 1))
    (model / "frames.bin").write_bytes(b"".join(frames))


def write_transforms(world: World, folder: Path) -> None:
    write_images(world, folder / "images")
    write_cloud(world, folder / "sparse_pc.ply")
    width, height = world.size
    frames = [
        {"file_path": f"images/{name}.png", "transform_matrix": world.world_from_cam(i, OPENGL).tolist()}
        for i, name in enumerate(world.names)
    ]
    meta = {
        "camera_model": "EQUIRECTANGULAR",
        **{"w": width, "h": height, "fl_x": height, "fl_y": height, "cx": width / 2, "cy": height / 2},
        "ply_file_path": "sparse_pc.ply",
        "frames": frames,
        "train_filenames": [f"images/{name}.png" for name in world.train],
        "val_filenames": [],
        "test_filenames": [f"images/{name}.png" for name in world.test],
    }
    (folder / "transforms.json").write_text(json.dumps(meta, indent=2))


def write_openmvg(world: World, folder: Path) -> None:
    write_images(world, folder / "images")
    write_lists(world, folder)
    views, extrinsics = _openmvg(world)
    width, height = world.size
    intrinsic = {"ptr_wrapper": {"id": 2147483800, "data": {"value0": {"width": width, "height": height}}}}
    structure = []
    for k, point in enumerate(world.points):
        seen = [_project(point[None], world.rotations[i], world.centers[i], width)[0] for i in range(2)]
        observations = [{"key": i, "value": {"id_feat": k, "x": list(x)}} for i, x in enumerate(seen)]
        structure.append({"key": k, "value": {"X": point.tolist(), "observations": observations}})
    data = {
        "sfm_data_version": "0.3",
        "root_path": "/home/somebody/else/images",
        "views": views,
        "intrinsics": [
            {"key": 0, "value": {"polymorphic_id": 2147483649, "polymorphic_name": "spherical", **intrinsic}}
        ],
        "extrinsics": extrinsics,
        "structure": structure,
        "control_points": [],
    }
    (folder / "sfm_data.json").write_text(json.dumps(data))


def write_opensfm(world: World, folder: Path) -> None:
    write_images(world, folder / "images")
    write_lists(world, folder, ".png")
    width, height = world.size
    shots = {
        f"{name}.png": {
            "rotation": Rotation.from_matrix(world.rotations[i]).as_rotvec().tolist(),
            "translation": world.translations[i].tolist(),
            "camera": "v2 camera spherical",
            "orientation": 1,
            "capture_time": 0.0,
        }
        for i, name in enumerate(world.names)
    }
    points = {
        str(k): {"color": [float(c) for c in color], "coordinates": point.tolist()}
        for k, (point, color) in enumerate(zip(world.points, world.colors, strict=True))
    }
    camera = {"projection_type": "spherical", "width": width, "height": height}
    small = {"cameras": {"c": camera}, "shots": {}, "points": {}}
    whole = {"cameras": {"v2 camera spherical": camera}, "shots": shots, "points": points}
    (folder / "reconstruction.json").write_text(json.dumps([small, whole]))


def write_roam360(world: World, folder: Path) -> None:
    write_images(world, folder / "images", "jpg")
    write_cloud(world, folder / "scene.ply")
    poses = {
        side: [
            {"rgb_file": f"{name}.jpg", "transform_matrix": world.world_from_cam(world.names.index(name)).tolist()}
            for name in names
        ]
        for side, names in (("train", world.train), ("test", world.test))
    }
    (folder / "pose_c2w.json").write_text(json.dumps(poses))


def write_ricoh360(world: World, folder: Path) -> None:
    """Write the camera line of OpenMVG's export, which COLMAP does not know; images.txt names the files as .jpg."""
    write_images(world, folder / "imgs")
    Image.fromarray(np.full(world.images[0].shape[:2], 255, np.uint8)).save(folder / "imgs" / "mask.png")
    write_lists(world, folder)
    _colmap_text(world, folder / "output_dir" / "colmap", "SPHERICAL", camera_id=0, extension="jpg")


def write_omniblender(world: World, folder: Path) -> None:
    write_images(world, folder / "images")
    write_lists(world, folder)
    width, height = world.size
    frames = [
        {"file_path": f"{name}.png", "transform_matrix": world.world_from_cam(i, OPENGL).tolist()}
        for i, name in enumerate(world.names)
    ]
    meta = {"indoor": True, "width": width, "height": height, "frames": frames}
    (folder / "transform.json").write_text(json.dumps(meta))


def write_released(world: World, folder: Path) -> None:
    write_images(world, folder / "images")
    write_lists(world, folder)
    write_cloud(world, folder / "pcd.ply")
    views, extrinsics = _openmvg(world)
    (folder / "data_views.json").write_text(json.dumps({"views": views}))
    (folder / "data_extrinsics.json").write_text(json.dumps({"extrinsics": extrinsics}))


def similarity(seed: int) -> NDArray[np.float64]:
    """Return a rotation, translation and scale [4, 4] that are not trivial."""
    source, matrix = np.random.default_rng(seed), np.eye(4)
    rotation = Rotation.from_quat(source.normal(size=4)).as_matrix()
    matrix[:3, :3], matrix[:3, 3] = source.uniform(0.2, 5) * rotation, source.normal(size=3) * 3
    return matrix


def write_metashape(world: World, folder: Path, chunk: bool = True, cloud: str = "chunk") -> None:
    """Write two spherical sensors and components under a chunk, with the cloud in the frame of the chunk or the world.

    A disabled camera, one that is not aligned, and a sensor of another type that only they use are there, too.
    """
    write_images(world, folder / "images")
    write_lists(world, folder)
    outer = similarity(1) if chunk else np.eye(4)
    inner = [similarity(2), similarity(3)]
    width, height = world.size
    sensors = "".join(
        f'<sensor id="{i}" label="S{i}" type="{kind}"><resolution width="{width}" height="{height}"/></sensor>'
        for i, kind in enumerate(("spherical", "spherical", "frame"))
    )
    components = "".join(
        f'<component id="{i}" label="Component {i}">{_metashape_transform(matrix)}</component>'
        for i, matrix in enumerate(inner)
    )
    cameras = [
        '<camera id="90" sensor_id="2" component_id="0" label="off" enabled="false"><transform>1</transform></camera>',
        '<camera id="91" sensor_id="2" label="lost"/>',
    ]
    for i, name in enumerate(world.names):
        pose = np.linalg.inv(outer @ inner[i % 2]) @ world.world_from_cam(i)
        pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
        cameras.append(
            f'<camera id="{i}" sensor_id="{i % 2}" component_id="{i % 2}" label="{name}" enabled="true">'
            f"<transform>{' '.join(map(repr, pose.ravel().tolist()))}</transform></camera>"
        )
    groups = f'<group id="0" label="Group 1">{"".join(cameras[:4])}</group>{"".join(cameras[4:])}'
    (folder / "cameras.xml").write_text(
        f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f"<sensors>{sensors}</sensors><components>{components}</components><cameras>{groups}</cameras>"
        f"{_metashape_transform(outer) if chunk else ''}</chunk></document>"
    )
    frame = np.linalg.inv(outer) if cloud == "chunk" else np.eye(4)
    points = world.points @ frame[:3, :3].T + frame[:3, 3]
    write_cloud(replace(world, points=points), folder / "dense.ply")


def _metashape_transform(matrix: NDArray[np.float64]) -> str:
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    parts = {"rotation": matrix[:3, :3] / scale, "translation": matrix[:3, 3], "scale": scale}
    text = "".join(f"<{key}>{' '.join(map(repr, np.ravel(x).tolist()))}</{key}>" for key, x in parts.items())
    return f"<transform>{text}</transform>"


PANORAMA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x ahead, y left, z up, in camera axes


def write_navvis(world: World, folder: Path, turn: float = 0.0) -> None:
    """Write pano-poses.csv; images are turned by `turn` degrees to the left of what the poses say."""
    write_images(world, folder / "pano")
    write_lists(world, folder)
    write_cloud(world, folder / "pointcloud.ply")
    head = "filename; timestamp; pano_pos_x; pano_pos_y; pano_pos_z; pano_ori_w; pano_ori_x; pano_ori_y; pano_ori_z"
    rows = [f"# pano poses v1.0: ID; {head}"]
    for i, name in enumerate(world.names):
        axes = PANORAMA @ Rotation.from_euler("z", -turn, degrees=True).as_matrix()
        numbers = [*world.centers[i], *quaternion(axes.T @ world.rotations[i], inverse=True)]
        rows.append("; ".join([str(i), f"{name}.png", "1644454371.893008", *(repr(float(x)) for x in numbers)]))
    (folder / "pano" / "pano-poses.csv").write_text("\n".join(rows) + "\n")


WRITERS = {
    "colmap": write_colmap_binary,
    "transforms": write_transforms,
    "openmvg": write_openmvg,
    "opensfm": write_opensfm,
    "roam360": write_roam360,
    "ricoh360": write_ricoh360,
    "omniblender": write_omniblender,
    "released": write_released,
    "metashape": write_metashape,
    "navvis": write_navvis,
}


def quaternion(rotation: NDArray[np.float64], inverse: bool = False) -> NDArray[np.float64]:
    """Return (w, x, y, z), w >= 0."""
    return np.roll(Rotation.from_matrix(rotation.T if inverse else rotation).as_quat(canonical=True), 1)


def _exit(center: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points where rays from inside leave the box."""
    with np.errstate(divide="ignore"):
        distance = ((np.sign(direction) * HALF - center) / direction).min(-1, keepdims=True)
    return center + distance * direction


def paint(points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the colours of the box at points on it."""
    phase = np.array([[0.0, 1.0, 2.0]])
    waves = np.sin(points @ np.array([[1.3, -0.4, 0.9], [0.5, 1.7, -1.1], [-0.8, 0.6, 1.5]]) + phase)
    return np.rint(127.5 + 110 * waves).astype(np.uint8)


def _panorama(rotation: NDArray[np.float64], center: NDArray[np.float64], width: int) -> NDArray[np.uint8]:
    height = width // 2
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (((np.arange(height) + 0.5) / height - 0.5) * np.pi)[:, None]
    rays = np.stack(
        [np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude, np.cos(latitude) * np.cos(longitude)],
        -1,
    )
    return paint(_exit(center, rays @ rotation))


def _project(
    points: NDArray[np.float64], rotation: NDArray[np.float64], center: NDArray[np.float64], width: int
) -> NDArray[np.float64]:
    x, y, z = ((points - center) @ rotation.T).T
    radius = np.sqrt(x * x + y * y + z * z)
    return np.stack(
        [(np.arctan2(x, z) / (2 * np.pi) + 0.5) * width, (np.arcsin(y / radius) / np.pi + 0.5) * width / 2], -1
    )


def _colmap_text(world: World, model: Path, camera: str, camera_id: int = 1, extension: str = "png") -> None:
    model.mkdir(parents=True)
    width, height = world.size
    comment = "# written\n# by\n# hand\n"
    (model / "cameras.txt").write_text(f"{comment}{camera_id} {camera} {width} {height} {width} {height}\n")
    lines = []
    for i, name in enumerate(world.names):
        pose = " ".join(repr(float(x)) for x in (*quaternion(world.rotations[i]), *world.translations[i]))
        lines += [f"{i + 1} {pose} {camera_id} {name}.{extension}", ""]
    (model / "images.txt").write_text(comment + "# and again\n" + "\n".join(lines) + "\n")
    rows = [
        " ".join([str(k + 1), *(repr(float(x)) for x in point), *(str(int(c)) for c in color), "0.1"])
        for k, (point, color) in enumerate(zip(world.points, world.colors, strict=True))
    ]
    (model / "points3D.txt").write_text(comment + "\n".join(rows) + "\n")


def _openmvg(world: World) -> tuple[list, list]:
    width, height = world.size
    views, extrinsics = [], []
    for i, name in enumerate(world.names):
        data = {"local_path": "", "filename": f"{name}.png", "width": width, "height": height}
        data |= {"id_view": i, "id_intrinsic": 0, "id_pose": i}
        wrapper = {"id": 2147483649 + i, "data": data}
        views.append({"key": i, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": wrapper}})
        pose = {"rotation": world.rotations[i].tolist(), "center": world.centers[i].tolist()}
        extrinsics.append({"key": i, "value": pose})
    return views, extrinsics
