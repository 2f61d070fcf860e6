"""Probes: zeros that a drawing is made with, whose gradient says how hard one view pulls at each Gaussian.

That gradient is the densification signal of `padgs.clone_split`. image: the pull on the projected mean, in normalised
image units (3DGS, OmniGS). space: on the mean itself, in units of half its distance from the camera, so that no
projection is involved: 0.5 * distance * |dL/dmean| (SPaGS).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.render import Rendering, RenderOptions, render
from padgs.scene import View

SIGNALS = ("image", "space")


def render_probed(
    gaussians: Gaussians,
    view: View,
    options: RenderOptions,
    *,
    signal: str,
    probe: Tensor | None = None,
    backend: str = "auto",
) -> tuple[Rendering, Tensor]:
    """Render, and the probe: [N, 2] for signal image, [N, 3] world axes for space; `backward` fills its gradient.

    A `probe` that is given is used again: its gradient is then the sum of several drawings of the same Gaussians.

    What the colours depend on is no part of either signal, also where they depend on the direction of the mean.
    """
    means = gaussians.means
    if signal == "image":
        probe = means.new_zeros(len(means), 2, requires_grad=True) if probe is None else probe
        return render(gaussians, view, options, probe=probe, backend=backend), probe
    if signal != "space":
        raise ValueError(f"unknown signal {signal!r}; known: {', '.join(SIGNALS)}")
    probe = torch.zeros_like(means, requires_grad=True) if probe is None else probe
    distance = (means.detach() - view.center.to(means)).norm(dim=-1, keepdim=True)
    return render(replace(gaussians, means=means + 0.5 * distance * probe), view, options, backend=backend), probe
