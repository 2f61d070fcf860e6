"""What a method is: the one lifecycle under which all of them are trained, timed, stressed and compared.

A method says how its trainee starts on a scene and how it is made again for a stored model; everything else is here.
Whoever trains one (`padgs.runs`) knows nothing else of it.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, ClassVar

import torch

from padgs.geometry.camera import Panorama
from padgs.render import RenderConfig, Rendering
from padgs.render.contract import check_camera
from padgs.scene import Scene, View
from padgs.training.budget import Budget
from padgs.training.failure import is_out_of_memory
from padgs.training.loop import Record, Stage, Trainer
from padgs.training.options import TrainOptions
from padgs.training.schedule import PUBLISHED_ITERATIONS
from padgs.training.trainee import Size, State, Trainee
from padgs.training.views.corrections import LEARNED

REHEARSED = 0.02  # share of a budget of seconds after which the speed of a method is known
SLOWER = 0.6  # of the speed at the beginning, as models grow


class Method(ABC):
    """A panoramic view-synthesis method.

    Attributes:
        Options: a dataclass with a default for every field, what `method` holds in the configuration.
        CUT_FINENESS: how much finer than in a panorama it takes the pixels of any other view to be.
        RENDER, TRAIN: how the method is drawn and trained unless the configuration says otherwise.
        options, render_config, train_options, seed: as constructed.
    """

    Options: ClassVar[type]
    CUT_FINENESS: ClassVar[float] = 1.0
    RENDER: ClassVar[RenderConfig] = RenderConfig()
    TRAIN: ClassVar[TrainOptions] = TrainOptions()

    def __init__(
        self,
        options: Any = None,
        render: RenderConfig | None = None,
        train: TrainOptions | None = None,
        seed: int = 0,
    ) -> None:
        """Prepare; there is no model before `fit` or `load_state`.

        Raises:
            ValueError: with these options nothing could be trained, whatever the scene.
        """
        self.options, self.seed = options or self.Options(), seed
        self.render_config, self.train_options = render or self.RENDER, train or self.TRAIN
        self._trainee: Trainee | None = None
        self._trainer: Trainer | None = None
        self._loaded: State | None = None
        self._given: State | None = None  # whose model `fit` begins with
        self._gaussians: int | str | None = None  # of the budget of `fit`
        self._refuse_impossible()

    def fit(self, scene: Scene, budget: Budget, *, stage: Stage = nullcontext) -> Iterator[Record]:
        """Train, from the point cloud of the scene or from a loaded state, yielding a record per iteration.

        The caller may stop between two records, at any time, and call `state()` then. `stage`: see `Trainer`.

        With seconds instead of iterations a few steps are taken first and thrown away, on account of the seconds: they
        say how many iterations the schedule is written for.

        Raises:
            ValueError: at once: the scene, or what is asked for, is nothing for this method.
            Failure: while training: the run ends with a status other than ok.
        """
        if not scene.train:
            raise ValueError(f"scene {scene.name!r} has no training view; mend its split")
        self.refuse_budget(budget)
        self._gaussians = budget.gaussians
        spent = {"seconds": 0.0, "cpu_seconds": 0.0}
        if budget.seconds is not None:
            if self._loaded is None:
                length, spent = self._rehearsed(scene, budget)
            else:
                length = self._loaded.values["schedule"]
            budget = replace(budget, iterations=length)
        self._trainee = self._begun(scene, budget.iterations)
        self._trainer = self._trained_by(self._trainee, scene, budget, stage)
        self._trainer.seconds += spent["seconds"]
        self._trainer.cpu_seconds += spent["cpu_seconds"]
        if self._given is not None:
            self._trainer.take_corrections(self._given)
        if self._loaded is not None:
            self._trainer.load_state(self._loaded)
            self._loaded = None
        return self._trainer.records()

    def begin_with(self, state: State) -> None:
        """Have `fit` begin with the model of another training on this scene, in place of the point cloud.

        Nothing else goes on: the schedule, the optimiser and what was noted for growth begin anew. Corrections of views
        are taken over where both trainings learn them.
        """
        self._given = state

    def stop(self, why: str) -> bool:
        """End the training of `fit` soon, between two of its records; see `Trainer.stop`."""
        assert self._trainer is not None, "only what is trained can be stopped"
        return self._trainer.stop(why)

    @property
    def ended(self) -> str:
        """Why training left out a part of its schedule; empty where it did not."""
        return self.state().values.get("ended", "") if self._trainer is None else self._trainer.ended

    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        return self.trainee.render(view)

    def size(self) -> Size:
        """Counts and bytes of the model."""
        return self.trainee.size()

    def state(self) -> State:
        """Model, optimiser, statistics, random state and data order.

        Raises:
            RuntimeError: neither `fit` nor `load_state` has been called.
        """
        if self._trainer is not None:
            return self._trainer.state()
        if self._loaded is not None:
            return self._loaded
        raise RuntimeError(f"{type(self).__name__} has no state yet; call fit or load_state first")

    def load_state(self, state: State) -> None:
        """Become the method that `state` was taken of; `render` works at once, `fit` goes on from there."""
        self._trainee = self._blank(state)
        self._trainee.load_state(state.of_model())
        self._trainer, self._loaded = None, state

    def drawn_with(self, render: RenderConfig) -> Method:
        """A copy of the trained method that draws in another way."""
        other = copy.copy(self)  # not made anew: it need not be able to train, or to draw panoramas
        other.render_config = render
        other.load_state(self.state())
        return other

    def resumed(self, scene: Scene, iterations: int) -> Any:
        """The loaded model as it is in training, of so many iterations: for whoever changes or trains it otherwise.

        Raises:
            RuntimeError: nothing was loaded.
            ValueError: the scene is nothing for this method.
        """
        model = self.state().of_model()
        trainee = self._start(scene, iterations)
        trainee.load_state(model)
        return trainee

    @property
    def is_drawn_no_finer(self) -> bool:
        """Whether the model is drawn no finer than its training views were by itself, whatever the filter of a view."""
        return False

    @property
    def start(self) -> int:
        """How many Gaussians, anchors or other parts the model had before the first iteration of `fit`."""
        return self.state().values["start"] if self._trainer is None else self._trainer.start

    @property
    def trainee(self) -> Any:
        """The model, as it is in training: a `Trainee`, of the type that `_start` of the method makes.

        Raises:
            RuntimeError: neither `fit` nor `load_state` has been called.
        """
        if self._trainee is None:
            raise RuntimeError(f"{type(self).__name__} has no model yet; call fit or load_state first")
        return self._trainee

    def _refuse_impossible(self) -> None:
        """Refuse what no scene could be trained or drawn with; subclasses know more."""
        check_camera(Panorama(8, 4), self.render_config.options(scene_scale=1.0))

    def refuse_budget(self, budget: Budget) -> None:
        """Refuse what cannot be trained for so long, or so large, on any scene; subclasses know more.

        Raises:
            ValueError: this budget is nothing for these options.
        """
        if budget.stop == "auto" and self._views_learn:
            raise ValueError(
                "budget.stop is auto, which measures on views that are set apart, but exposures or cameras learn along "
                "here, and those of such views do not; set it to end"
            )

    def refuse_search(self) -> None:
        """Refuse the search for the smallest model (`padgs.need`) on any scene; subclasses know more.

        Raises:
            ValueError: with these options there is nothing to search.
        """
        if self._views_learn:
            raise ValueError(
                "need compares pictures with photographs, but exposures or cameras learn along here; take a method "
                "that does not calibrate, with train.exposures=given and train.poses=given"
            )

    @property
    def _views_learn(self) -> bool:
        """Whether something of single views is learned, which views without gradients then lack."""
        return LEARNED in (self.train_options.exposures, self.train_options.poses)

    @abstractmethod
    def _start(self, scene: Scene, iterations: int) -> Trainee:
        """What is trained on a scene, for so many iterations.

        Raises:
            ValueError: the scene, or what is asked for, is nothing for this method.
        """

    @abstractmethod
    def _blank(self, state: State) -> Trainee:
        """A trainee that can load the model of this state, to be looked at; `fit` makes another one."""

    def _begun(self, scene: Scene, iterations: int) -> Trainee:
        """What is trained on a scene, with the model of another training if there is one to begin with.

        Raises:
            ValueError: as `_start` does, or that model is nothing for the options or the budget.
        """
        trainee = self._start(scene, iterations)
        if self._given is None:
            return trainee
        try:
            trainee.load_model(self._given.of_model())
        except (LookupError, TypeError, ValueError, RuntimeError) as error:
            if is_out_of_memory(error):
                raise
            raise ValueError(
                f"the model to begin with is nothing for these options ({error}); give those that it was trained with"
            ) from error
        count = next(iter(trainee.counts().values()))
        if isinstance(self._gaussians, int) and count > self._gaussians:
            raise ValueError(
                f"budget.gaussians is {self._gaussians}, but the model to begin with has {count} already; ask for as "
                "many or more, or take some away by padgs need"
            )
        return trainee

    def _rehearsed(self, scene: Scene, budget: Budget) -> tuple[int, dict[str, float]]:
        """How many iterations a budget of seconds should do, and what it took to find out.

        The steps are on one view, so that all but the first find its photograph read.
        """
        assert budget.seconds is not None
        random, first = torch.get_rng_state(), 0.0
        short = replace(
            budget, iterations=PUBLISHED_ITERATIONS, seconds=None, max_seconds=None, gaussians=None, stop="end"
        )
        one = replace(scene, train=scene.train[:1])
        trainer = self._trained_by(self._begun(scene, short.iterations), one, short, nullcontext)
        for record in trainer.records():
            if record.iteration == 1:  # which does what is done but once
                first = trainer.spent
            elif trainer.spent >= REHEARSED * budget.seconds:
                break
        torch.set_rng_state(random)
        each = (trainer.spent - first) / (trainer.iteration - 1)
        length = max(2, round(SLOWER * (budget.seconds - trainer.spent) / each))
        return length, {"seconds": trainer.seconds, "cpu_seconds": trainer.cpu_seconds}

    def _trained_by(self, trainee: Trainee, scene: Scene, budget: Budget, stage: Stage) -> Trainer:
        """The loop that it is trained in."""
        return Trainer(trainee, scene, budget, self.train_options, self.seed, stage=stage)
