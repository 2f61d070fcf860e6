"""Probes: zeros that a drawing is made with, whose gradient says how hard one view pulls at each Gaussian.

That gradient is the densification signal of `padgs.methods.splats.clone_split`. image: the pull on the projected mean, in
normalised image units (3DGS, OmniGS). space: on the mean itself, in units of half its distance from the camera, so that
no projection is involved: 0.5 * distance * |dL/dmean|, the pull by way of colours that depend on the direction included
(SPaGS). space_absolute: that, and the pulls of all pixels one by one, which do not cancel: 0.5 * distance *
sum |dL/dmean|, by way of the footprints alone (`padgs.render.backends.torch`).
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.splats.model import Splats
from padgs.render import Rendering, RenderOptions, render
from padgs.scene import View

SIGNALS = ("image", "space", "space_absolute")


def render_probed(
    splats: Splats,
    view: View,
    options: RenderOptions,
    *,
    signal: str,
    probe: Tensor | None = None,
    change: Callable[[Gaussians], Gaussians] = lambda gaussians: gaussians,
    backend: str = "auto",
) -> tuple[Rendering, Gaussians, Tensor]:
    """Render; returns what was drawn, too, and the probe, whose gradient `backward` fills.

    The probe is [N, 2] for signal image, [N, 3] world axes for space, and [N, 4] for space_absolute, which takes
    projection ray: world axes, then the sum of absolute pulls.

    A `probe` that is given is used again: its gradient is then the sum of several drawings of the same Gaussians.

    `change` is made to the Gaussians before they are drawn.

    Raises:
        ValueError: unknown signal, or what `render` raises.
    """
    means = splats.means
    if signal == "image":
        probe = means.new_zeros(len(means), 2, requires_grad=True) if probe is None else probe
        gaussians = change(splats.gaussians(view))
        return render(gaussians, view, options, mean_offsets=probe, backend=backend), gaussians, probe
    if signal not in SIGNALS:
        raise ValueError(f"unknown signal {signal!r}; known: {', '.join(SIGNALS)}")
    absolute = signal == "space_absolute"
    probe = means.new_zeros(len(means), 4 if absolute else 3, requires_grad=True) if probe is None else probe
    gaussians, pulls = splats.probed(view, probe)
    gaussians = change(gaussians)
    return render(gaussians, view, options, absgrad=pulls, backend=backend), gaussians, probe
