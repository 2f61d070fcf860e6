"""Growth by error: new Gaussians at training pixels that are rendered wrong (ConeGS, Baranowski et al. 2025).

A pixel of a training view is drawn with a probability in proportion to its error and its solid angle. Its Gaussian is
put at the rendered distance, has the colour of the photograph, and is about as wide as the pixel there.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from padgs.geometry import harmonics
from padgs.methods.splats.splats import MIN_INITIAL_COLOR
from padgs.render import Rendering
from padgs.scene import View
from padgs.training.targets import even_weight, image_of

VIEWS = 8  # last rendered views that pixels are taken from
PIXELS = 2048  # candidates per view, drawn when the view is rendered
MAX_TRANSMITTANCE = 0.1  # of a pixel whose rendered distance is that of a surface
SIGMA = 0.45  # of a new Gaussian, in pixels at its distance
OPACITY = 0.5  # of a new Gaussian


class WrongPixels:
    """Candidates for new Gaussians, drawn from the last `VIEWS` rendered views.

    Attributes:
        rows: [C, 8] float32: position (world), colour, standard deviation (world units), and weight of the pixel.
    """

    COLUMNS = (3, 3, 1, 1)

    def __init__(self, generator: torch.Generator) -> None:
        """Start without candidates; `generator` is on the CPU."""
        self._generator = generator
        self.rows = torch.zeros(0, sum(self.COLUMNS))

    @torch.no_grad()
    def observe(self, view: View, rendering: Rendering) -> None:
        """Draw candidates from a rendered training view and its photograph as it is; those of the oldest view go."""
        image = image_of(view, rendering.image.device)
        error = (rendering.image - image).abs().mean(-1) * even_weight(view, image.device)
        surface = (rendering.transmittance < MAX_TRANSMITTANCE) & (rendering.depth > 0)
        cumulative = torch.where(surface, error, 0.0).double().flatten().cumsum(0)
        total = cumulative[-1]
        shares = torch.rand(PIXELS, dtype=torch.float64, generator=self._generator).sort().values.to(total)
        pixels = torch.searchsorted(cumulative, shares * total, right=True).clamp(max=len(cumulative) - 1)
        # A pixel that is drawn twice counts twice, once: two equal Gaussians would stay equal. Its other rows stay with
        # weight 0, so that rounding in one of them changes no choice of another.
        first = pixels.diff(prepend=pixels.new_tensor([-1])) > 0
        number = first.cumsum(0) - 1
        times = torch.zeros_like(number).index_add(0, number, torch.ones_like(number))
        weights = torch.where(first, times[number] * total / PIXELS, 0.0)
        rays, depth = view.camera.rays().to(image).reshape(-1, 3)[pixels], rendering.depth.flatten()[pixels, None]
        pose = view.cam_from_world.to(image)
        positions = (rays / rays.norm(dim=-1, keepdim=True) * depth - pose[:3, 3]) @ pose[:3, :3]
        colors, sigmas = image.reshape(-1, 3)[pixels], SIGMA * depth / view.camera.focal
        new = torch.cat((positions, colors, sigmas, weights[:, None].to(image)), dim=1)
        self.rows = torch.cat((self.rows.to(new), new))[-VIEWS * PIXELS :]

    def take(self, count: int, parameters: Mapping[str, nn.Parameter]) -> dict[str, Tensor]:
        """Return rows of parameters for at most `count` new Gaussians, by weight, and forget all candidates."""
        weights = self.rows[:, -1].double().cpu()
        count = min(count, int((weights > 0).sum()))
        chosen = torch.multinomial(weights, count, generator=self._generator) if count > 0 else torch.zeros(0).long()
        positions, colors, sigmas, _ = self.rows[chosen.to(self.rows.device)].split(self.COLUMNS, dim=1)
        new = {name: value.new_zeros(count, *value.shape[1:]) for name, value in parameters.items()}
        new["means"], new["log_scales"] = positions, sigmas.log().expand(-1, 3)
        new["quats"][:, 0] = 1.0
        new["opacity_logits"] += math.log(OPACITY / (1 - OPACITY))
        new["sh_dc"] = harmonics.dc_from_colors(colors.clamp(min=MIN_INITIAL_COLOR))
        self.rows = self.rows[:0]
        return new
