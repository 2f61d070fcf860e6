"""Example of a reader in another package: `poses.csv` with the columns name, qw, qx, qy, qz, x, y, z."""

import csv
from pathlib import Path

import torch

from padgs.data.capture import Capture, DataError, DataOptions, Frame
from padgs.data.formats.poses import cam_from_panorama


def read(path: Path, options: DataOptions) -> Capture:
    """Return poses and names; padgs then finds and checks images, masks, depth maps and the split."""
    frames = []
    try:
        for row in csv.DictReader((path / "poses.csv").read_text("utf-8").splitlines()):
            groups = ("qw qx qy qz", "x y z")
            turn, center = (torch.tensor([float(row[key]) for key in keys.split()]) for keys in groups)
            pose = cam_from_panorama(turn.double(), center.double(), row["name"])
            frames.append(Frame(row["name"], path / "images" / row["name"], pose))
    except (OSError, KeyError, ValueError) as error:
        raise DataError(f"{path / 'poses.csv'} cannot be used ({error}); export it again") from error
    return Capture("my_format", path, path / "images", tuple(frames), cloud=None)
