"""Conversion of poses in files to `cam_from_world` [4, 4] float64, with checks shared by all formats.

Matrices that are not rotations are refused, because slightly wrong poses silently cost quality.
"""

import torch
from torch import Tensor

from padgs.data.capture import FARTHEST, DataError

REMEDY = "remove the image or compute its pose again"
TOLERANCE = 1e-3  # of R R^T - I; accepts files with four digits, refuses scaled or sheared matrices

# `OPENCV_FROM_OPENGL @ x_gl` is x right, y down, z forward.
OPENCV_FROM_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # OpenGL: y up, z backward
# Camera axes (right, down, forward) in the frame of scanners: x forward, y left, z up.
PANORAMA_FROM_CAMERA = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Return the rigid transform [4, 4] float64 of a rotation [3, 3] and a translation [3]."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def cam_from_world(rotation: Tensor, translation: Tensor, where: str) -> Tensor:
    """Return the pose [4, 4] of a cam-from-world rotation [3, 3] and translation [3]; `where` names it in errors."""
    return rigid(checked_rotation(rotation, where), _finite(translation, where))


def cam_from_center(rotation: Tensor, center: Tensor, where: str) -> Tensor:
    """Return the pose [4, 4] of a cam-from-world rotation [3, 3] and the camera centre [3] in the world."""
    rotation = checked_rotation(rotation, where)
    return rigid(rotation, -rotation @ _finite(center, where))


def cam_from_pose(world_from_cam: Tensor, where: str) -> Tensor:
    """Return the pose [4, 4] of a world-from-cam matrix [3 or 4, 4] of an OpenCV camera."""
    matrix = torch.as_tensor(world_from_cam, dtype=torch.float64)
    if matrix.dim() != 2 or matrix.shape[0] not in (3, 4) or matrix.shape[1] != 4:
        raise DataError(f"{where}: a pose has the shape {list(matrix.shape)}; it must be 4x4 (or 3x4)")
    if matrix.shape[0] == 4:
        _refuse_zeros(_finite(matrix, where)[:3, :3], where)
        if torch.allclose(matrix[:3, 3], torch.zeros(3, dtype=torch.float64)) and matrix[3, :3].abs().max() > 1e-9:
            found = f"the pose is transposed, its last row {_numbers(matrix[3])} holds the translation"
            raise DataError(f"{where}: {found}; write it with the translation in the last column")
        if not torch.allclose(matrix[3], torch.tensor([0, 0, 0, 1], dtype=torch.float64), atol=1e-6):
            raise DataError(f"{where}: the last row of the pose is {_numbers(matrix[3])}; it must be 0 0 0 1")
    return cam_from_center(checked_rotation(matrix[:3, :3], where).T, matrix[:3, 3], where)


def cam_from_opengl_pose(world_from_cam: Tensor, where: str) -> Tensor:
    """Return the pose [4, 4] of a world-from-cam matrix [3 or 4, 4] of an OpenGL camera: x right, y up, z backward."""
    return rigid(OPENCV_FROM_OPENGL, torch.zeros(3, dtype=torch.float64)) @ cam_from_pose(world_from_cam, where)


def cam_from_panorama(quaternion: Tensor, center: Tensor, where: str) -> Tensor:
    """Return the pose [4, 4] of a scanner's panorama, stated by a quaternion (w, x, y, z) and its centre in the world.

    The centre of the image is along x of the panorama, and z points up.
    """
    rotation = rotation_from_quaternion(quaternion, where) @ PANORAMA_FROM_CAMERA
    return cam_from_center(rotation.T, center, where)


def rotation_from_quaternion(quaternion: Tensor, where: str) -> Tensor:
    """Return the rotation [3, 3] of a quaternion (w, x, y, z), which must have unit length up to rounding."""
    quaternion = _finite(quaternion, where)
    length = _refuse_zeros(quaternion, where).norm().item()
    if abs(length - 1) > 0.01:
        raise DataError(f"{where}: the quaternion has the length {length:.4g}; it must be 1: divide it by that")
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.from_quat(quaternion.roll(-1).numpy()).as_matrix())


def rotation_from_vector(vector: Tensor, where: str) -> Tensor:
    """Return the rotation [3, 3] of a rotation vector: axis times angle in radians."""
    x, y, z = _finite(vector, where).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(cross)


def checked_rotation(rotation: Tensor, where: str) -> Tensor:
    """Return the rotation nearest to a [3, 3] matrix, which must be one up to rounding, as float64.

    A DataError says that it is not finite, scaled, left-handed or not orthogonal.
    """
    rotation = _refuse_zeros(_finite(rotation, where), where)
    if rotation.shape != (3, 3):
        raise DataError(f"{where}: a rotation has the shape {list(rotation.shape)}; it must be 3x3")
    gram = rotation @ rotation.T
    identity = torch.eye(3, dtype=torch.float64)
    if (off := (gram - identity).abs().max()) > TOLERANCE:
        scale = gram.diagonal().mean().sqrt().item()
        if scale > 0 and (gram / scale**2 - identity).abs().max() <= TOLERANCE:
            remedy = "scale belongs to the positions: divide the 3x3 part by it"
            raise DataError(f"{where}: the pose holds a rotation times {scale:.6g}; {remedy}")
        raise DataError(
            f"{where}: the 3x3 part of the pose is not a rotation: R R^T differs from the identity by "
            f"{off.item():.3g} (at most {TOLERANCE:g} is accepted as rounding); export it with four digits or more"
        )
    if (determinant := torch.linalg.det(rotation).item()) < 0:
        remedy = "one axis is mirrored, negate the column of the axis that points the wrong way"
        raise DataError(f"{where}: the pose is left-handed (determinant {determinant:.3f}); {remedy}")
    left, _, right = torch.linalg.svd(rotation)
    return left @ right


def _refuse_zeros(rotation: Tensor, where: str) -> Tensor:
    """Return a rotation in any form; a DataError if it is 0, as programs write it for images without a pose."""
    if rotation.numel() and rotation.abs().max() < 1e-12:
        raise DataError(f"{where}: the rotation is all zeros, so the image has no pose; {REMEDY}")
    return rotation


def _finite(values: Tensor, where: str) -> Tensor:
    values = torch.as_tensor(values, dtype=torch.float64)
    if not values.isfinite().all():
        raise DataError(f"{where}: the pose contains {_numbers(values[~values.isfinite()][:1])}; {REMEDY}")
    if (far := values[values.abs() > FARTHEST]).numel():
        rule = f"nothing farther than {FARTHEST:g} from the origin can be rendered"
        raise DataError(f"{where}: the pose contains {_numbers(far[:1])}; {rule}: {REMEDY}")
    return values


def _numbers(values: Tensor) -> str:
    return " ".join(f"{value:g}" for value in values.tolist())
