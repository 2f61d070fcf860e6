"""Cameras of photographs in COLMAP models: a pinhole, or a ray for each pixel."""

import signal
import threading
from functools import lru_cache
from types import ModuleType

import numpy as np
import torch
from numpy.typing import NDArray

from padgs.data.capture import DataError
from padgs.data.formats.colmap_files import Camera
from padgs.geometry.camera import Pinhole, RayTable

MAX_RAY_ERROR = 0.1  # pixels, between a pixel and the projection of its ray
POLYNOMIAL_FISHEYES = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")


def lens_of(camera: Camera, where: str, width: int, height: int) -> Pinhole | RayTable:
    """Return the camera of photographs at a size; `where` names one in errors.

    A DataError says that COLMAP does not have the model or its parameters, or that pixels have no ray.
    """
    try:
        return _lens(camera, width, height)
    except (ValueError, RuntimeError) as error:
        numbers = ", ".join(f"{number:g}" for number in camera.params)
        raise DataError(
            f"{where} has a {camera.model} camera of {camera.width}x{camera.height} with parameters {numbers}: "
            f"{error}; export the model again, undistort the photographs (`colmap image_undistorter`), or leave them "
            "out with data.cameras=panoramas"
        ) from error


@lru_cache(maxsize=16)  # a table of rays takes four times the memory of an image
def _lens(camera: Camera, width: int, height: int) -> Pinhole | RayTable:
    colmap, number = pycolmap_module(), camera.model.removeprefix("type ")
    name = colmap.CameraModelId(int(number)).name if number.isdigit() else camera.model
    if name not in colmap.CameraModelId.__members__:
        raise ValueError("COLMAP has no such model")
    model = colmap.Camera(model=name, width=camera.width, height=camera.height, params=camera.params)
    if not model.verify_params() or not np.isfinite(camera.params).all() or not model.mean_focal_length() > 0:
        raise ValueError("these are no parameters of this model")
    model.rescale(width, height)
    focal = np.array((model.focal_length_x, model.focal_length_y))
    middle = np.array((model.principal_point_x, model.principal_point_y))
    if name.endswith("PINHOLE"):
        return Pinhole(width, height, *focal.tolist(), *middle.tolist())
    rows, columns = np.mgrid[:height, :width] + 0.5
    pixels = np.stack((columns, rows), -1).reshape(-1, 2)
    if name in POLYNOMIAL_FISHEYES:
        rays = fisheye_rays((pixels - middle) / focal, model.params[list(model.extra_params_idxs())])
    else:
        rays = np.asarray(model.cam_ray_from_img(pixels), np.float64)
        off = np.linalg.norm(np.asarray(model.img_from_cam(rays), np.float64) - pixels, axis=1)
        rays[~(off < MAX_RAY_ERROR)] = np.nan
    if missing := np.isnan(rays).any(1).mean():
        raise ValueError(f"{missing:.2%} of its pixels lie outside of the lens")
    return RayTable(torch.from_numpy(rays.reshape(height, width, 3)).float(), model.mean_focal_length(), name.lower())


def fisheye_rays(places: NDArray[np.float64], k: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit rays [P, 3] of a fisheye at places [P, 2], in focal lengths from the principal point; NaN: outside.

    The radius at an angle t from the axis is t (1 + k1 t^2 + k2 t^4 + ...). COLMAP inverts that below 90 degrees only.
    """
    angles = np.linspace(0, np.pi, 100_001)
    radii = angles * np.polynomial.Polynomial((1, *k))(angles**2)
    falls = np.flatnonzero(np.diff(radii) <= 0)
    rising = slice(None, falls[0] + 1 if len(falls) else None)
    radius = np.linalg.norm(places, axis=1)
    angle = np.interp(radius, radii[rising], angles[rising], right=np.nan)
    across = np.sin(angle) / np.maximum(radius, 1e-12)
    return np.column_stack((places * across[:, None], np.cos(angle)))


def pycolmap_module() -> ModuleType:
    """Import pycolmap without breaking PNG files of Pillow and the handler of SIGTERM."""
    import zlib  # noqa: F401 - first, or pycolmap's deflate symbols replace the system's

    import pycolmap

    if threading.current_thread() is threading.main_thread():  # the handler of its library calls SIGTERM a crash
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    return pycolmap
