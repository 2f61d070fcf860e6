"""Explicit Gaussians in another world: turned, scaled and shifted, with the colours that are seen from each side."""

from __future__ import annotations

import torch
from torch import Tensor

from padgs.geometry import harmonics
from padgs.methods.calibration.align import Similarity
from padgs.methods.splats.model import Splats

DOWN = (0.0, 1.0, 0.0)  # of a viewer's world, as far as the PLY of 3DGS has one: that of most structure from motion


@torch.no_grad()
def moved(splats: Splats, new_from_old: Similarity) -> Splats:
    """The same Gaussians in a new world."""
    from scipy.spatial.transform import Rotation

    rotation = new_from_old.rotation.to(splats.means)
    turn = Rotation.from_matrix(new_from_old.rotation.cpu().numpy()) * Rotation.from_quat(
        splats.quats.cpu().double().roll(-1, 1).numpy()
    )
    sh = harmonics_turn(rotation, splats.degree) @ torch.cat((splats.sh_dc[:, None], splats.sh_rest), dim=1)
    empty = splats.means[:0]
    new = Splats(empty, empty, empty, degree=splats.degree, unit=splats.unit * new_from_old.scale)
    new.load(
        {
            "means": new_from_old(splats.means.to(new_from_old.rotation)).to(splats.means),
            "quats": torch.from_numpy(turn.as_quat()).roll(1, 1).to(splats.quats),
            "log_scales": splats.log_scales + torch.tensor(new_from_old.scale).log(),
            "opacity_logits": splats.opacity_logits,
            "sh_dc": sh[:, 0],
            "sh_rest": sh[:, 1:],
        }
    )
    new.active_degree = splats.active_degree
    return new


def harmonics_turn(rotation: Tensor, degree: int) -> Tensor:
    """The matrix [K, K] that maps coefficients of harmonics to those of the turned function, for a rotation [3, 3].

    Turned functions are combinations of the same harmonics, so that as many directions as there are coefficients, in
    general position, say which.
    """
    directions = torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    old = harmonics.basis(directions @ rotation.double().cpu(), degree)  # directions in the old world, R^T d
    return torch.linalg.lstsq(harmonics.basis(directions, degree), old).solution.to(rotation)


def upright(up: Tensor) -> Similarity:
    """The smallest turn after which `up` [3] points against `DOWN`."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.align_vectors([-torch.tensor(DOWN).numpy()], [up.cpu().numpy()])[0]
    return Similarity(1.0, torch.from_numpy(turn.as_matrix()), torch.zeros(3, dtype=torch.float64))
