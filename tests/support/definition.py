"""Footprints from the definition, written independently of the renderer, without bounds and cut.

Everything is float64 and happens in the camera frame: the pose is the identity. Low-pass filters are those that each
projection was published with.
"""

import math

import torch
from torch import Tensor

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable
from padgs.render import RenderOptions
from padgs.render.contract import ALPHA_MIN

MARGIN = 1e-3  # relative; closer than this to flipping, rounding may decide


def alphas(gaussians: Gaussians, camera: Camera, options: RenderOptions, pixels: Tensor | None = None) -> Tensor:
    """Return alpha [N, P] of every Gaussian at every pixel, before the cut and the maximum; 0 where it does not act.

    Args:
        gaussians: float64.
        pixels: [P] row W + column; all of them, in this order, if not given.
    """
    if pixels is None:
        pixels = torch.arange(camera.width * camera.height)
    pixels = pixels.double()  # exact, and so is what follows from them
    row, column = torch.div(pixels, camera.width, rounding_mode="floor"), pixels % camera.width
    footprint = {"erp": _planar, "pinhole": _planar, "tangent": _tangent, "ray": _ray}[options.projection]
    q, opacities, acts = footprint(gaussians, camera, options, row, column)
    return torch.where(acts, opacities[:, None] * torch.exp(-0.5 * q), torch.zeros_like(q))


def near_a_decision(alpha: Tensor) -> Tensor:
    """Return where [...] rounding may decide whether a pair contributes."""
    return ((alpha / ALPHA_MIN - 1).abs() < MARGIN) | ((alpha / 0.99 - 1).abs() < MARGIN)


def blended(gaussians: Gaussians, alpha: Tensor) -> Tensor:
    """Return the image [P, 3] over black of alphas [N, P], one Gaussian after the other."""
    image = torch.zeros(alpha.shape[1], 3, dtype=alpha.dtype)
    left = torch.ones_like(alpha[0])
    alive = torch.ones_like(left, dtype=torch.bool)
    for index in torch.argsort(gaussians.means.norm(dim=-1), stable=True).tolist():
        here = torch.where(alpha[index] >= ALPHA_MIN, alpha[index].clamp(max=0.99), torch.zeros_like(left))
        alive &= left * (1 - here) >= 1e-4
        weight = torch.where(alive, left * here, torch.zeros_like(left))
        image += weight[:, None] * gaussians.colors[index]
        left = left - weight
    return image


def _covariances(gaussians: Gaussians) -> Tensor:
    spread = rotation_matrices(gaussians.quats) * gaussians.scales[:, None, :]
    return spread @ spread.transpose(1, 2)


def _planar(gaussians: Gaussians, camera: Camera, options: RenderOptions, row: Tensor, column: Tensor):
    x, y, z = gaussians.means.unbind(-1)
    zero, r = torch.zeros_like(x), gaussians.means.norm(dim=-1)
    if isinstance(camera, Pinhole):
        a = (x / z).clamp(-0.65 * camera.width / camera.fx, 0.65 * camera.width / camera.fx)
        b = (y / z).clamp(-0.65 * camera.height / camera.fy, 0.65 * camera.height / camera.fy)
        row_u = torch.stack((camera.fx / z, zero, -camera.fx * a / z), dim=-1)
        row_v = torch.stack((zero, camera.fy / z, -camera.fy * b / z), dim=-1)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        drawn = z > options.near
    else:
        rho = torch.hypot(x, z)
        c = (rho / r).clamp(min=1e-4)
        east = torch.stack((z, zero, -x), dim=-1) / rho[:, None]
        down = torch.stack((-x * y, rho * rho, -y * z), dim=-1) / (rho * r)[:, None]
        row_u = camera.width / (2 * math.pi) * east / (r * c)[:, None]
        row_v = camera.height / math.pi * down / r[:, None]
        u = (torch.atan2(x, z) / (2 * math.pi) + 0.5) * camera.width
        v = (torch.atan2(y, rho) / math.pi + 0.5) * camera.height
        drawn = r > options.near
    jacobian = torch.stack((row_u, row_v), dim=1)
    covariance = jacobian @ _covariances(gaussians) @ jacobian.transpose(1, 2)
    inverse = torch.linalg.inv(covariance + options.low_pass * torch.eye(2, dtype=x.dtype))
    du, dv = column + 0.5 - u[:, None], row + 0.5 - v[:, None]
    if options.wrap and isinstance(camera, Panorama):
        du = (du + camera.width / 2) % camera.width - camera.width / 2
    a, b, d = (inverse[:, i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    q = a * du * du + 2 * b * du * dv + d * dv * dv
    return q, gaussians.opacities, drawn[:, None].expand_as(q)


def _directions(camera: Camera, row: Tensor, column: Tensor) -> Tensor:
    """Unit directions [P, 3] of some pixels; not `camera.rays`, so that large cameras cost nothing."""
    if isinstance(camera, RayTable):
        return camera.table[row.long(), column.long()].double()
    if isinstance(camera, Panorama):
        longitude = ((column + 0.5) / camera.width - 0.5) * (2 * math.pi)
        latitude = ((row + 0.5) / camera.height - 0.5) * math.pi
        flat = torch.cos(latitude)
        return torch.stack((flat * torch.sin(longitude), torch.sin(latitude), flat * torch.cos(longitude)), dim=-1)
    d = torch.stack(((column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy), dim=-1)
    d = torch.cat((d, torch.ones_like(d[:, :1])), dim=-1)
    return d / d.norm(dim=-1, keepdim=True)


def _tangent(gaussians: Gaussians, camera: Camera, options: RenderOptions, row: Tensor, column: Tensor):
    d = _directions(camera, row, column)
    r = gaussians.means.norm(dim=-1)
    n = gaussians.means / r[:, None]
    basis = torch.linalg.svd(n[:, None, :]).Vh[:, 1:]  # [N, 2, 3]: what is orthogonal to n
    covariance = basis @ _covariances(gaussians) @ basis.transpose(1, 2) / (r * r)[:, None, None]
    covariance = covariance + options.low_pass / camera.focal**2 * torch.eye(2, dtype=r.dtype)
    ahead = n @ d.T  # [N, P]
    tau = torch.einsum("nic,pc->npi", basis, d) / ahead[..., None]
    q = torch.einsum("npi,nij,npj->np", tau, torch.linalg.inv(covariance), tau)
    return q, gaussians.opacities, (ahead > 0) & (r > options.near)[:, None]


def _ray(gaussians: Gaussians, camera: Camera, options: RenderOptions, row: Tensor, column: Tensor):
    d = _directions(camera, row, column)
    mean, r = gaussians.means, gaussians.means.norm(dim=-1)
    variances = gaussians.scales**2
    wide = variances + options.low_pass * (r / camera.focal)[:, None] ** 2
    opacities = gaussians.opacities * (variances / wide).prod(-1).sqrt()
    axes = rotation_matrices(gaussians.quats)
    precision = axes / wide[:, None, :] @ axes.transpose(1, 2)
    through = torch.einsum("nc,ncd,pd->np", mean, precision, d) / torch.einsum("pc,ncd,pd->np", d, precision, d)
    miss = mean[:, None] - through[..., None] * d
    q = torch.einsum("npc,ncd,npd->np", miss, precision, miss)
    distance = torch.einsum("nc,ncd,nd->n", mean, precision, mean)
    outside = (distance > 2 * torch.log(opacities / ALPHA_MIN)) & (r > options.near)
    return q, opacities, (through > options.near) & outside[:, None]


def one_pixel(alphas: list[float], distances: list[float], size: int) -> tuple[list[float], float]:
    """Blend one pixel in the hybrid way as published: fragments arrive one by one, evicted ones join the tail.

    Return weights and transmittance of fragments in order of arrival for a core of `size`; alpha 0: no fragment."""
    core: list[int] = []
    tail: list[int] = []
    for i, alpha in enumerate(alphas):
        if 0 < alpha < 0.05:
            tail.append(i)
        elif alpha > 0:
            place = sum(distances[j] <= distances[i] for j in core)
            core.insert(place, i)
            tail += core[size:]
            del core[size:]
    weights, left = [0.0] * len(alphas), 1.0
    for i in core:
        weights[i] = alphas[i] * left
        left *= 1 - alphas[i]
        left = left if left >= 1e-4 else 0.0
    total, through = sum(alphas[i] for i in tail), math.prod(1 - alphas[i] for i in tail)
    for i in tail:
        weights[i] = left * (1 - through) * alphas[i] / total
    return weights, left * through
