"""The panoramic (equirectangular, ERP) camera: direction <-> longitude/latitude <-> pixel. Paper Eq. 6-7.

Camera frame: x right, y down, z forward. Longitude = atan2(x, z), 0 straight ahead, positive to the right;
latitude = asin(y / r), 0 at the horizon, positive *down*. Pixels are continuous: u = (longitude / 2 pi + 1/2) W,
v = (latitude / pi + 1/2) H, and the centre of the pixel in row i, column j is (u, v) = (j + 1/2, i + 1/2).
This is COLMAP's EQUIRECTANGULAR camera. The paper's Eq. 6 is the same map with renamed axes:
(x, y, z) of the paper = (-z, x, y) here.
"""

import math

import torch
from torch import Tensor

Device = torch.device | str
CUBIC_REACH = 2  # support of a bicubic sample in pixels


def longitude_latitude(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return longitude in (-pi, pi] and latitude in [-pi/2, pi/2] of camera-frame points (Eq. 6).

    The latitude is atan2(y, rho), which is accurate near the poles, unlike asin(y / r). Points [..., 3] have any length
    but zero.

    >>> longitude, latitude = longitude_latitude(torch.tensor([1.0, 0.0, 0.0]))
    >>> round(longitude.item() / math.pi, 6), latitude.item()
    (0.5, 0.0)
    """
    x, y, z = points.unbind(-1)
    return torch.atan2(x, z), torch.atan2(y, torch.sqrt(x * x + z * z))


def direction(longitude: Tensor, latitude: Tensor) -> Tensor:
    """Return the unit direction [..., 3] in the camera frame of a longitude and latitude in radians (inverse Eq. 6)."""
    flat = torch.cos(latitude)
    return torch.stack((flat * torch.sin(longitude), torch.sin(latitude), flat * torch.cos(longitude)), dim=-1)


def pixel_from_angles(longitude: Tensor, latitude: Tensor, width: int, height: int) -> Tensor:
    """Return continuous pixel coordinates (u, v) [..., 2] of a longitude and latitude (Eq. 7)."""
    return torch.stack(((longitude / (2 * math.pi) + 0.5) * width, (latitude / math.pi + 0.5) * height), dim=-1)


def project(points: Tensor, width: int, height: int) -> Tensor:
    """Return the pixel (u, v) [..., 2] of camera-frame points [..., 3] (Eq. 6 and 7).

    >>> project(torch.tensor([0.0, 0.0, 2.0]), 8, 4)
    tensor([4., 2.])
    """
    return pixel_from_angles(*longitude_latitude(points), width, height)


def row_latitudes(height: int, *, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
    """Return the latitude in radians of each image row centre, [H], from nearly -pi/2 (up) to nearly +pi/2 (down).

    >>> row_latitudes(2) / math.pi
    tensor([-0.2500,  0.2500])
    """
    rows = torch.arange(height, dtype=dtype, device=device)
    return ((rows + 0.5) / height - 0.5) * math.pi


def rays(width: int, height: int, *, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
    """Return unit directions [H, W, 3] in the camera frame through all pixel centres."""
    columns = torch.arange(width, dtype=dtype, device=device)
    longitude = ((columns + 0.5) / width - 0.5) * (2 * math.pi)
    latitude = row_latitudes(height, dtype=dtype, device=device)
    return direction(longitude.expand(height, width), latitude[:, None].expand(height, width))


def projection_jacobian(points: Tensor, width: int, height: int, *, min_cos_latitude: float = 0.0) -> Tensor:
    """Return the Jacobian d(u, v) / d(x, y, z) of `project`, in pixels per unit length, [..., 2, 3].

    With r = |p|, rho^2 = x^2 + z^2, c = rho / r = cos(latitude):
    first row (W / 2 pi) east / (r c), second row (H / pi) down / r, where east = (z, 0, -x) / rho and
    down = (-x y, rho^2, -y z) / (rho r).

    `min_cos_latitude` is the lower limit of c in the first row, which is unbounded at the poles otherwise. On the polar
    axis, where east is undefined, camera x is used as east.
    """
    x, y, z = points.unbind(-1)
    rho_squared = x * x + z * z
    r_squared = rho_squared + y * y
    r = torch.sqrt(r_squared)
    on_axis = rho_squared == 0
    rho = torch.sqrt(torch.where(on_axis, torch.ones_like(rho_squared), rho_squared))
    east_x = torch.where(on_axis, torch.ones_like(x), z / rho)
    east_z = torch.where(on_axis, torch.zeros_like(x), -x / rho)
    sin_latitude = y / r
    cos_latitude = torch.where(on_axis, torch.zeros_like(rho), rho) / r
    per_east = width / (2 * math.pi) / (r * cos_latitude.clamp(min=min_cos_latitude))
    per_down = height / math.pi / r
    zero = torch.zeros_like(x)
    # down = latitude direction: -sin(latitude) * horizontal + cos(latitude) * y; horizontal = (-east_z, 0, east_x).
    row_u = torch.stack((per_east * east_x, zero, per_east * east_z), dim=-1)
    along = per_down * sin_latitude
    row_v = torch.stack((along * east_z, per_down * cos_latitude, -along * east_x), dim=-1)
    return torch.stack((row_u, row_v), dim=-2)


def sample(image: Tensor, directions: Tensor) -> Tensor:
    """Return bilinear samples [..., C] of a panorama [H, W, C] at directions [..., 3], as in `sample_pixels`."""
    height, width = image.shape[:2]
    return sample_pixels(image, project(directions, width, height))


def sample_bicubic(image: Tensor, directions: Tensor) -> Tensor:
    """Return bicubic samples [..., C] of a panorama [H, W, C] at directions [..., 3], across the seam and the poles.

    The convolution of Keys (1981) with a = -1/2, exact for parabolas and at pixel centres. It overshoots at edges.
    """
    height, width = image.shape[:2]
    around = pad_panorama(image if image.is_floating_point() else image.float(), CUBIC_REACH)
    u, v = (project(directions, width, height) - 0.5).unbind(-1)
    column, row = u.floor(), v.floor()
    across, down = _bicubic_weights(u - column).to(around), _bicubic_weights(v - row).to(around)
    columns = (column.long() + CUBIC_REACH - 1)[..., None] + torch.arange(4, device=image.device)
    rows = row.long() + CUBIC_REACH - 1
    samples = torch.zeros(*directions.shape[:-1], image.shape[2], dtype=around.dtype, device=image.device)
    for step in range(4):
        line = (across[..., None] * around[(rows + step)[..., None], columns]).sum(-2)
        samples += down[..., step, None] * line
    return samples


def _bicubic_weights(t: Tensor) -> Tensor:
    """Return weights [..., 4] of the pixels -1, 0, 1 and 2 for positions t in [0, 1) after pixel 0."""
    weights = (((2 - t) * t - 1) * t, (3 * t - 5) * t * t + 2, ((4 - 3 * t) * t + 1) * t, (t - 1) * t * t)
    return torch.stack(weights, dim=-1).div(2)


def pad_panorama(image: Tensor, margin: int) -> Tensor:
    """Return a panorama [H, W, ...] continued by `margin` pixels on each side, across its seam and its poles.

    Left and right it wraps. Beyond a pole it continues down the opposite meridian: row -k is row k - 1 rolled by W / 2.
    """
    height, width = image.shape[:2]
    if width % 2:
        raise ValueError(f"cannot continue a {width}x{height} panorama: its width must be even; resize it")
    rows = torch.arange(-margin, height + margin, device=image.device)[:, None] % (2 * height)  # a whole great circle
    beyond = rows >= height
    columns = torch.arange(-margin, width + margin, device=image.device) + beyond * (width // 2)
    return image[torch.where(beyond, 2 * height - 1 - rows, rows), columns % width]


def sample_pixels(image: Tensor, pixels: Tensor) -> Tensor:
    """Return bilinear samples [..., C] of a panorama [H, W, C] at pixel coordinates, across the seam and the poles.

    Differentiable by both. Pixels are continuous (u, v) [..., 2]; u any number of turns, v within the image.
    """
    height, width = image.shape[:2]
    image = image if image.is_floating_point() else image.float()
    flat = image.reshape(height * width, -1)
    u, v = (pixels - 0.5).unbind(-1)
    column, row = u.detach().floor().long(), v.detach().floor().long()
    across, down = (u - column)[..., None].to(image), (v - row)[..., None].to(image)

    def at(start: Tensor, column: Tensor) -> Tensor:
        return flat.index_select(0, (start + column).flatten()).reshape(*column.shape, -1)

    def line(row: Tensor) -> Tensor:
        beyond = (row < 0) | (row >= height)  # a pole: the next row is the same row, half a turn further
        left = torch.where(beyond, column + width // 2, column) % width
        start = row.clamp(0, height - 1) * width
        return at(start, left).lerp(at(start, (left + 1) % width), across)

    return line(row).lerp(line(row + 1), down)
