"""All that training learns of its views, as the loop has it; held-out views and stored models do without."""

from __future__ import annotations

from torch import Tensor, nn

from padgs.scene import Scene, View
from padgs.training.schedule import ParameterGroup
from padgs.training.views.exposure import Exposures
from padgs.training.views.poses import SMALL, PoseRefinement

GIVEN, LEARNED = "given", "learned"
CHOICES = (GIVEN, LEARNED)  # of exposures, and of poses


class Corrections(nn.Module):
    """Corrections of the training views of a scene; without parameters where nothing is corrected."""

    def __init__(self, scene: Scene, *, exposures: bool, poses: bool) -> None:
        """No correction yet.

        Raises:
            ValueError: poses shall learn, but two views have one name.
        """
        super().__init__()
        self.exposures = Exposures(len(scene.train)) if exposures else None
        self.poses = PoseRefinement.of(scene.train, unit=scene.scale) if poses else None

    def groups(self, iterations: int) -> list[ParameterGroup]:
        """All parameters, with their learning rates in a run of `iterations`."""
        exposures = [] if self.exposures is None else self.exposures.groups()
        return exposures + ([] if self.poses is None else self.poses.groups(SMALL, iterations))

    def posed(self, view: View) -> View:
        """A training view where it is taken to have been; differentiable."""
        return view if self.poses is None else self.poses.refined(view)

    def exposed(self, image: Tensor, index: int) -> Tensor:
        """What was drawn of training view `index`, [H, W, 3], as its photograph was exposed; differentiable."""
        return image if self.exposures is None else self.exposures.exposed(image, index)

    def centre(self) -> None:
        """Have all corrections together change nothing; called after each step of the optimiser."""
        for part in (self.exposures, self.poses):
            if part is not None:
                part.centre()
