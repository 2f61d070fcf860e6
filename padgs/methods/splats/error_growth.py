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
        rows: [C, 9] float32: position (world), colour, standard deviation (world units), weight of the pixel, and
            number of the observation.
    """

    COLUMNS = (3, 3, 1, 1, 1)

    def __init__(self, generator: torch.Generator) -> None:
        """Start without candidates; `generator` is on the CPU."""
        self._generator = generator
        self.rows = torch.zeros(0, sum(self.COLUMNS))

    @torch.no_grad()
    def observe(self, view: View, rendering: Rendering) -> None:
        """Draw candidates from a rendered training view; those of the oldest view go."""
        image = image_of(view, rendering.image.device)
        error = (rendering.image - image).abs().mean(-1) * even_weight(view, image.device)
        surface = (rendering.transmittance < MAX_TRANSMITTANCE) & (rendering.depth > 0)
        cumulative = torch.where(surface, error, 0.0).double().flatten().cumsum(0)
        total = cumulative[-1]
        if not total > 0:
            return
        shares = torch.rand(PIXELS, dtype=torch.float64, generator=self._generator).to(total)
        drawn = torch.searchsorted(cumulative, shares * total, right=True).clamp(max=len(cumulative) - 1)
        pixels, times = drawn.unique(return_counts=True)  # twice the same Gaussian would stay the same
        rays, depth = view.camera.rays().to(image).reshape(-1, 3)[pixels], rendering.depth.flatten()[pixels, None]
        pose = view.cam_from_world.to(image)
        positions = (rays / rays.norm(dim=-1, keepdim=True) * depth - pose[:3, 3]) @ pose[:3, :3]
        number = 1 + (float(self.rows[-1, -1]) if len(self.rows) else 0.0)
        weights = torch.stack((times * total / PIXELS, torch.full_like(times, number, dtype=torch.float64)), dim=1).to(
            image
        )
        new = torch.cat((positions, image.reshape(-1, 3)[pixels], SIGMA * depth / view.camera.focal, weights), dim=1)
        self.rows = torch.cat((self.rows[self.rows[:, -1] > number - VIEWS].to(new), new))

    def take(self, count: int, parameters: Mapping[str, nn.Parameter]) -> dict[str, Tensor]:
        """Return rows of parameters for at most `count` new Gaussians, by weight, and forget all candidates."""
        weights = self.rows[:, -2].double().cpu()
        count = min(count, int((weights > 0).sum()))
        chosen = torch.multinomial(weights, count, generator=self._generator) if count > 0 else torch.zeros(0).long()
        positions, colors, sigmas, *_ = self.rows[chosen.to(self.rows.device)].split(self.COLUMNS, dim=1)
        new = {name: value.new_zeros(count, *value.shape[1:]) for name, value in parameters.items()}
        new["means"], new["log_scales"] = positions, sigmas.log().expand(-1, 3)
        new["quats"][:, 0] = 1.0
        new["opacity_logits"] += math.log(OPACITY / (1 - OPACITY))
        new["sh_dc"] = harmonics.dc_from_colors(colors.clamp(min=MIN_INITIAL_COLOR))
        self.rows = self.rows[:0]
        return new
