"""EgoNeRF (Choi et al. 2023) as a method: a radiance field on spherical grids, rendered by sampling rays."""

from dataclasses import fields, replace

import torch

from padgs.methods.egonerf.field import EgoNeRF, EgoNeRFOptions
from padgs.methods.egonerf.model import EgoNeRFModel, RayTrainer
from padgs.render import RenderConfig
from padgs.scene import Scene
from padgs.training.loop import Stage
from padgs.training.method import Method
from padgs.training.model import State
from padgs.training.options import Budget, TrainOptions

BACKENDS = ("auto", "torch")


class EgoNeRFMethod(Method):
    """See `padgs.training.method.Method`; most options of renderer and loss do not apply."""

    Options = EgoNeRFOptions
    TRAIN = TrainOptions(weight="uniform", learning_rates="published", adam_beta2=0.99)

    def refuse_budget(self, budget: Budget) -> None:
        super().refuse_budget(budget)
        if budget.stop == "auto":
            raise ValueError("budget.stop is auto, which needs validation views, but rays come from all; set it to end")

    def build_model(self, scene: Scene, iterations: int) -> EgoNeRFModel:
        return EgoNeRFModel(EgoNeRF.from_scene(scene, self.options, self.seed), iterations)

    def restore(self, state: State) -> EgoNeRFModel:
        stored = state.of_model()
        centre = torch.tensor(stored.values["centre"], dtype=torch.float64)
        model = EgoNeRF(self.options, centre, *(stored.values[name] for name in ("unit", "travel", "kind")))
        model = model.to(next(iter(stored.tensors.values())).device)
        return EgoNeRFModel(model, 1)

    def build_trainer(self, model: EgoNeRFModel, scene: Scene, budget: Budget, stage: Stage) -> RayTrainer:
        return RayTrainer(model, scene, budget, self.train_options, self.seed, rays=self.options.rays, stage=stage)

    def _refuse_impossible(self) -> None:
        train = self.train_options
        loss = replace(self.TRAIN, weight=train.weight, check_every=train.check_every, monitor=train.monitor)
        if self.render_config.backend not in BACKENDS:
            raise ValueError(
                f"egonerf has no backend {self.render_config.backend!r}; it casts rays in torch, known: "
                f"{', '.join(BACKENDS)}"
            )
        rays = RenderConfig(backend=self.render_config.backend)
        for group, given, possible, why in (
            ("render", self.render_config, rays, "casts rays and renders no Gaussians"),
            ("train", train, loss, "minimises the squared error of single rays, without Gaussians or images"),
        ):
            for field in fields(possible):
                if getattr(given, field.name) != getattr(possible, field.name):
                    raise ValueError(
                        f"egonerf {why}, so {group}.{field.name}={getattr(given, field.name)} does not apply; "
                        f"leave it at {getattr(possible, field.name)}"
                    )
