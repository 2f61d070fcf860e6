"""The loop that every method trains in: iterations, time, Adam and its schedules, failures, and resuming.

What one iteration is, and in which order the data comes, is said by its subclasses.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Protocol

import torch
from torch import Tensor, nn

from padgs.learning.failure import first_non_finite, is_out_of_memory
from padgs.learning.method import Budget, Failure, Record, State
from padgs.learning.schedule import ParameterGroup

MODEL = "model/"  # prefix of the model's own tensors in a state


class Optimisable(Protocol):
    """A model with parameters to learn.

    `load_state` must make the model what `state` was taken of, sizes included, and may replace the data of parameters
    but not the parameters returned by `groups`.
    """

    def groups(self) -> list[ParameterGroup]:
        """All learnable parameters, each in exactly one group."""
        ...

    def counts(self) -> dict[str, int]:
        """What the model consists of now: anchors, gaussians, ..."""
        ...

    def state(self) -> State:
        """Parameters, statistics and random state, without the optimiser."""
        ...

    def load_state(self, state: State) -> None:
        """Become the model that `state` was taken of."""
        ...


class TrainingLoop(ABC):
    """A generator of records. Knows no files.

    Between two records `state` holds all that continuing bit-identically needs (on the CPU); `load_state` goes back
    there. A resumed run goes on counting its training time.
    """

    def __init__(
        self,
        model: Optimisable,
        budget: Budget,
        *,
        check_every: int,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ) -> None:
        """Prepare; nothing is drawn yet.

        Args:
            model: what is optimised.
            budget: for how long.
            check_every: iterations between checks of all gradients and parameters for values that are not finite.
            betas, eps: of Adam. The default eps is that of 3DGS, where gradients of single Gaussians are tiny.
        """
        self.iteration = 0
        self.seconds = 0.0
        self._model, self._budget, self._check_every = model, budget, check_every
        self._groups = model.groups()
        # fused is 2 to 3 times faster on CPUs.
        self._optimizer = torch.optim.Adam(
            [{"params": list(group.parameters), "name": group.name} for group in self._groups],
            betas=betas,
            eps=eps,
            fused=True,
        )

    def records(self) -> Iterator[Record]:
        """Train to the end of the budget, yielding a record after each iteration.

        Stops early, without an error, once the training time has reached `Budget.max_seconds`; the caller sees it by
        the iteration of the last record and decides which status that is.

        Raises:
            Failure: nan (a loss, gradient or parameter is not finite; the reason names it and the iteration), oom, or
                collapsed (nothing is left to draw). The model is of no use then.
        """
        limit = self._budget.max_seconds
        while self.iteration < self._budget.iterations and (limit is None or self.seconds < limit):
            started = time.perf_counter()
            iteration = self.iteration + 1
            for group, settings in zip(self._groups, self._optimizer.param_groups, strict=True):
                settings["lr"] = group.learning_rate(iteration)
            try:
                loss, counts, events = self._step(iteration)
            except (MemoryError, RuntimeError) as error:
                if isinstance(error, Failure) or not is_out_of_memory(error):
                    raise
                raise Failure("oom", f"out of memory at iteration {iteration}: {error}") from error
            if iteration == self._budget.iterations:
                self._refuse_non_finite(self._parameters(), iteration)
            self.iteration = iteration
            self.seconds += time.perf_counter() - started
            yield Record(iteration, loss, self.seconds, counts, events)

    def state(self) -> State:
        """Copies of model, optimiser, statistics, random state and data order; to be taken between two records."""
        model, order = self._model.state(), self._order_state()
        tensors = {f"{MODEL}{name}": tensor for name, tensor in model.tensors.items()}
        for name, parameter in self._parameters().items():
            for key, value in self._optimizer.state.get(parameter, {}).items():
                tensors[f"adam/{name}/{key}"] = value
        tensors["random/torch"] = torch.get_rng_state()
        tensors |= order.tensors
        values = {"model": model.values, "iteration": self.iteration, "seconds": self.seconds, **order.values}
        return State({name: tensor.detach().clone() for name, tensor in tensors.items()}, values)

    def load_state(self, state: State) -> None:
        """Go on where `state` was taken; model, scene, budget and options must be those of that run.

        Raises:
            ValueError: the state is of a run on other data.
        """
        self._load_order(state)
        self._model.load_state(model_state(state))
        self._optimizer.state.clear()
        for name, parameter in self._parameters().items():
            prefix = f"adam/{name}/"
            moments = {
                key.removeprefix(prefix): value for key, value in state.tensors.items() if key.startswith(prefix)
            }
            if moments:
                self._optimizer.state[parameter] = {
                    key: value.to(parameter.device, copy=True) for key, value in moments.items()
                }
        torch.set_rng_state(state.tensors["random/torch"].cpu())
        self.iteration, self.seconds = state.values["iteration"], state.values["seconds"]

    @abstractmethod
    def _step(self, iteration: int) -> tuple[float | Tensor, dict[str, int], tuple[str, ...]]:
        """One iteration, `_update` included. Returns loss, counts and events of its record."""

    @abstractmethod
    def _order_state(self) -> State:
        """What decides which data the next iterations see. Not copies."""

    @abstractmethod
    def _load_order(self, state: State) -> None:
        """Take back what `_order_state` returned, out of the whole state; raise ValueError if the data are others."""

    def _check(self, iteration: int) -> None:
        """Look at all parameters and gradients where it is time to; called after `backward`."""
        if iteration % self._check_every == 0:
            gradients = {f"gradient of {name}": parameter.grad for name, parameter in self._parameters().items()}
            self._refuse_non_finite({**self._parameters(), **gradients}, iteration)

    def _read(self, loss: Tensor, iteration: int) -> float | Tensor:
        """The loss as a number. On a GPU, which the host would have to wait for, only where all is checked."""
        if loss.device.type == "cpu" or iteration % self._check_every == 0:
            return loss.item()
        return loss.detach()

    def _update(self) -> None:
        """Step Adam. The graph must be gone by now, if rows of its leaves come and go afterwards."""
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)

    def _parameters(self) -> dict[str, nn.Parameter]:
        """All parameters by a name for messages and checkpoints."""
        return {
            group.name if len(group.parameters) == 1 else f"{group.name}[{number}]": parameter
            for group in self._groups
            for number, parameter in enumerate(group.parameters)
        }

    def _refuse_non_finite(self, tensors: Mapping[str, Tensor | None], iteration: int) -> None:
        bad = first_non_finite(tensors)
        if bad is not None:
            every = self._check_every
            raise Failure(
                "nan", f"{bad} at iteration {iteration} (all parameters are checked every {every} iterations)"
            )


def model_state(state: State) -> State:
    """The model's own part of what `TrainingLoop.state` returned, for models that are only looked at."""
    tensors = {name.removeprefix(MODEL): t for name, t in state.tensors.items() if name.startswith(MODEL)}
    return State(tensors, state.values["model"])
