"""Method: the lifecycle under which every method is trained, timed, perturbed and compared."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, ClassVar

import torch

from padgs.clock import Lap
from padgs.geometry.camera import Panorama, RayTable
from padgs.geometry.similarity import Similarity
from padgs.render import RenderConfig, Rendering
from padgs.render.contract import check_camera
from padgs.scene import Scene, View
from padgs.training.corrections import FISHEYES, GIVEN, LEARNED, LEARNED_FAST, PoseRefinement
from padgs.training.health import is_out_of_memory
from padgs.training.lenses import CameraMap
from padgs.training.loop import VIEWS, Stage, Trainer
from padgs.training.model import Model, Prunable, Record, Refined, Size, State
from padgs.training.options import CLOCKS, Budget, TrainOptions
from padgs.training.schedule import PUBLISHED_ITERATIONS

REHEARSED = 0.02  # share of a budget of seconds that measures the speed of a method
SLOWER = 0.6  # average speed over a run, relative to its beginning, as models grow


class Method(ABC):
    """A panoramic view-synthesis method."""

    Options: ClassVar[type]  # dataclass with a default for every field; the group `method` of the configuration
    CUT_FINENESS: ClassVar[float] = 1.0  # pixels of a perspective view are taken to be so much finer than a panorama's
    RENDER: ClassVar[RenderConfig] = RenderConfig()
    TRAIN: ClassVar[TrainOptions] = TrainOptions()
    HAS_GAUSSIANS: ClassVar[bool] = False  # the model keeps to `budget.gaussians`, and importance can prune it
    RUN_RATES: ClassVar[str] = "run"  # law that `train.learning_rates=run` stands for

    def __init__(
        self, options: Any = None, render: RenderConfig | None = None, train: TrainOptions | None = None, seed: int = 0
    ) -> None:
        """Check the options; those that can train on no scene are a ValueError."""
        self.options, self.seed = options or self.Options(), seed
        self.render_config, self.train_options = render or self.RENDER, train or self.TRAIN
        if self.train_options.learning_rates == "run":
            self.train_options = replace(self.train_options, learning_rates=self.RUN_RATES)
        self._model: Model | None = None
        self._trainer: Trainer | None = None
        self._camera: CameraMap | None = None  # that took all photographs, if it is learned
        self._poses: PoseRefinement | None = None  # of training views, if held-out views follow them
        self._loaded_state: State | None = None
        self._warm_start_state: State | None = None
        self._gaussians: int | str | None = None  # `Budget.gaussians` of `fit`
        self._refuse_impossible()

    @abstractmethod
    def build_model(self, scene: Scene, iterations: int) -> Model:
        """Return the untrained model for a scene and a schedule length; ValueError if it cannot train on the scene."""

    @abstractmethod
    def restore(self, state: State) -> Model:
        """Return a model with the shapes of a stored state, for rendering only; `load_state` fills it."""

    def build_trainer(self, model: Model, scene: Scene, budget: Budget, stage: Stage) -> Trainer:
        """Return the training loop for a model."""
        return Trainer(model, scene, budget, self.train_options, self.seed, stage=stage)

    def fit(self, scene: Scene, budget: Budget, *, stage: Stage = nullcontext) -> Iterator[Record]:
        """Train from the scene's point cloud, a warm start or a loaded state; yield a record per iteration.

        The caller may stop between two records and call `state()` then. With a budget of seconds, a few steps that are
        thrown away fix the length of the schedule; they and building the initial model count as training time. `stage`
        is entered with the name of each part of an iteration. A ValueError says at once that the method cannot train on
        this scene or within this budget; a Failure during training ends the run with a status other than ok.
        """
        lap = Lap()
        if not scene.train:
            raise ValueError(f"scene {scene.name!r} has no training view; correct its split")
        if self.train_options.poses == LEARNED_FAST and scene.has_single_center:
            raise ValueError(
                f"the {len(scene.train)} training cameras of scene {scene.name!r} stand in one place, which has no "
                f"scale to carry held-out views by; set train.poses={LEARNED} or {GIVEN}"
            )
        self._refuse_photographs(scene)
        self.refuse_budget(budget)
        if self.train_options.refine and self._warm_start_state is None and self._loaded_state is None:
            raise ValueError("train.refine refines the model of a finished run; set init=RUN, or train.refine=false")
        self._gaussians = budget.gaussians
        if budget.seconds is not None:
            known = None if self._loaded_state is None else self._loaded_state.values["schedule"]
            budget = replace(budget, iterations=known or self._schedule_length(scene, budget, lap))
        self._model = self._initial_model(scene, budget.iterations)
        trained: Any = self._model
        if self.train_options.refine:
            trained = Refined(self._model, self.train_options.learning_rates, budget.iterations)
        self._trainer = self.build_trainer(trained, scene, budget, stage)
        self._trainer.seconds, self._trainer.cpu_seconds = lap.seconds()
        self._trainer.began = self._trainer.spent
        if self._warm_start_state is not None:
            stored, own = self._warm_start_state.under(VIEWS), self._trainer.corrections.state_dict()
            other = {name.partition(".")[0] for name, of in stored.items() if of.shape != own.get(name, of).shape}
            whole = {name: of for name, of in stored.items() if name in own and name.partition(".")[0] not in other}
            self._trainer.corrections.load_state_dict(whole, strict=False)
        if self._loaded_state is not None:
            self._trainer.load_state(self._loaded_state)
            self._loaded_state = None
        corrections = self._trainer.corrections
        self._camera = corrections.lens if isinstance(corrections.lens, CameraMap) else None
        self._poses = corrections.poses if self.train_options.poses == LEARNED_FAST else None
        return self._trainer.records()

    def warm_start(self, state: State) -> None:
        """Let `fit` begin with the model of another training on this scene instead of the point cloud.

        Schedule, optimizer and statistics begin anew; view corrections are taken over if both trainings learn them, a
        camera map at the same image size.
        """
        self._warm_start_state = state

    def request_stop(self, reason: str) -> bool:
        """End the training of `fit` early, between two records; see `Trainer.request_stop`."""
        assert self._trainer is not None, "call fit before request_stop"
        return self._trainer.request_stop(reason)

    @property
    def ended(self) -> str:
        """The reason why training skipped part of its schedule; empty if it did not."""
        return self.state().values["ended"] if self._trainer is None else self._trainer.ended

    @property
    def start(self) -> int:
        """Number of Gaussians, anchors or other parts before the first iteration of `fit`."""
        return self.state().values["start"] if self._trainer is None else self._trainer.start

    @property
    def model(self) -> Any:
        """The `Model`, of the type that `build_model` returns."""
        if self._model is None:
            raise RuntimeError(f"{type(self).__name__} has no model yet; call fit or load_state first")
        return self._model

    def render(self, view: View) -> Rendering:
        """Render a view of the given world without gradients; a panorama as the learned camera would take it."""
        if (world := self.world) is not None:
            view = view.at(world.pose(view.cam_from_world))
        rendering = self.model.render(view)
        if world is not None:
            rendering = replace(rendering, depth=rendering.depth / world.scale)
        return self.photographed(rendering, view)

    def photographed(self, rendering: Rendering, view: View) -> Rendering:
        """Return an ideal render of a view as the learned camera would take it; the same where none is learned."""
        if self._camera is None or not isinstance(view.camera, Panorama):
            return rendering
        return self._camera.photographed(rendering)

    def size(self) -> Size:
        """Return counts and bytes of the model, with a learned camera."""
        size = self.model.size()
        if self._camera is None:
            return size
        camera = Size.of({}, self._camera.parameters(), stored=self._camera.parameters())
        return Size(size.counts, size.parameters + camera.parameters, size.bytes + camera.bytes)

    def state(self) -> State:
        """Return model, optimizer, statistics, random state and data order."""
        if self._trainer is not None:
            return self._trainer.state()
        if self._loaded_state is not None:
            return self._loaded_state
        raise RuntimeError(f"{type(self).__name__} has no state yet; call fit or load_state first")

    def load_state(self, state: State) -> None:
        """Load a state of this method; `render` works at once, `fit` resumes training."""
        self._model = self.restore(state)
        self._model.load_state(state.of_model())
        lens, poses = (state.under(f"{VIEWS}{part}.") for part in ("lens", "poses"))
        self._camera = CameraMap.restored(lens) if "offsets" in lens else None
        self._poses = PoseRefinement.restored(poses) if self.train_options.poses == LEARNED_FAST else None
        self._trainer, self._loaded_state = None, state

    def with_renderer(self, render: RenderConfig) -> Method:
        """Return a copy of the trained method with other render settings."""
        other = copy.copy(self)  # not constructed again: it need not be able to train, or to draw panoramas
        other.render_config = render
        other.load_state(self.state())
        return other

    @property
    def has_smoothing_filter(self) -> bool:
        """True if renders stay as smooth as those of the training views, whatever the pixels of a view."""
        return False

    @property
    def world(self) -> Similarity | None:
        """Similarity model_from_given of the world, if held-out views follow learned poses."""
        return None if self._poses is None else self._poses.world()

    @property
    def _name(self) -> str:
        return type(self).__name__.removesuffix("Method")

    def refuse_budget(self, budget: Budget) -> None:
        """Refuse a budget that this method cannot train within on any scene; subclasses add checks."""
        if budget.gaussians is not None and not self.HAS_GAUSSIANS:
            raise ValueError(f"budget.gaussians is {budget.gaussians}, but {self._name} has no Gaussians; leave it out")
        if budget.gaussians == "auto" and self.train_options.refine:
            raise ValueError("budget.gaussians is auto, which prunes after growth; with train.refine=true set a number")
        if budget.stop == "auto" and self.calibrates:
            raise ValueError(
                "budget.stop is auto, which measures validation views, but exposures or cameras are learned here, and "
                "validation views have none; set it to end"
            )

    def refuse_search(self) -> None:
        """Refuse the search for the smallest model (`padgs.runs.smallest`) on any scene; subclasses add checks."""
        if not self.HAS_GAUSSIANS:
            why = "no Gaussians to prune, so it has no smallest model"
            raise ValueError(f"{self._name} has {why}; take a method with Gaussians")
        if self.calibrates:
            raise ValueError(
                "the search for the smallest model compares renders with photographs, but exposures or cameras are "
                "learned here; take a method that does not calibrate, with train.exposures=given and train.poses=given"
            )

    def _refuse_impossible(self) -> None:
        """Refuse options with which no scene can be trained or rendered; subclasses add checks."""
        check_camera(Panorama(8, 4), self.render_config.options(scene_scale=1.0))
        if self.train_options.lens.startswith(FISHEYES):
            check_camera(RayTable(torch.zeros(1, 1, 3), focal=1.0), self.render_config.options(scene_scale=1.0))

    def _refuse_photographs(self, scene: Scene) -> None:
        """Refuse photographs beside the panoramas of a scene if the renderer draws panoramas only."""
        if scene.train[0].lens is not None or not self.HAS_GAUSSIANS:  # views cut from panoramas; rays of any camera
            return
        for view in (*scene.train, *scene.test):
            try:
                check_camera(view.camera, self.render_config.options(scene_scale=1.0))
            except ValueError as error:
                why = f"{error}; or set data.cameras=panoramas"
                raise ValueError(f"{view.name} is a photograph beside panoramas: {why}") from error

    @property
    def calibrates(self) -> bool:
        """True if exposures, poses or a lens are learned; held-out views have none then."""
        options = self.train_options
        return not options.exposures == options.poses == options.lens == GIVEN

    def _initial_model(self, scene: Scene, iterations: int) -> Model:
        """Return `build_model`, with the parameters of the warm start if there is one, pruned to the budget."""
        model = self.build_model(scene, iterations)
        if self._warm_start_state is None:
            return model
        try:
            model.load_model(self._warm_start_state.of_model())
        except (LookupError, TypeError, ValueError, RuntimeError) as error:
            if is_out_of_memory(error):
                raise
            raise ValueError(
                f"the model of the warm start does not fit these options ({error}); use those that it was trained with"
            ) from error
        if isinstance(self._gaussians, int) and self._gaussians < next(iter(model.counts().values())):
            assert isinstance(model, Prunable), "other models refuse a budget of Gaussians"
            model.prune(self._gaussians, scene.train)
        return model

    def _schedule_length(self, scene: Scene, budget: Budget, lap: Lap) -> int:
        """Return the schedule length for a budget of seconds since the start of `lap`, by some steps on one view."""
        assert budget.seconds is not None
        random, first = torch.get_rng_state(), 0.0
        short = Budget(PUBLISHED_ITERATIONS, clock=budget.clock)
        wanted = [view for view in scene.train if view.load_depth] if self.train_options.depth_weight else []
        one = replace(scene, train=tuple(wanted[:1]) or scene.train[:1])
        trainer = self.build_trainer(self._initial_model(scene, short.iterations), one, short, nullcontext)
        for record in trainer.records():
            if record.iteration == 1:  # includes work that is done only once
                first = trainer.spent
            elif trainer.spent >= REHEARSED * budget.seconds:
                break
        torch.set_rng_state(random)
        each = (trainer.spent - first) / (trainer.iteration - 1)
        left = budget.seconds - lap.seconds()[CLOCKS.index(budget.clock)]
        return max(2, round(SLOWER * left / each))
