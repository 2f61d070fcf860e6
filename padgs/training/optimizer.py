"""Adam with a learning rate per parameter group, and edits of parameter rows that keep its moments consistent.

Parameters (`nn.Parameter`) keep their identity; their `.data` and Adam moments are replaced and gradients dropped. No
graph over the old rows may be alive when the next one is built.
"""

import inspect
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from padgs.training.health import Failure
from padgs.training.model import State
from padgs.training.schedule import Pace, ParameterGroup

MOMENTS = ("exp_avg", "exp_avg_sq")
ADAM = "adam/"  # prefix of its tensors in a state
READ_EVERY = 10  # iterations between reads of the loss from a GPU


def keep_rows(parameters: Mapping[str, nn.Parameter], optimizer: torch.optim.Adam | None, keep: Tensor) -> None:
    """Keep rows of every parameter [N, ...] with their Adam moments: [N] bool, or row numbers in the wanted order."""
    for parameter in parameters.values():
        parameter.data = parameter.data[keep]
        parameter.grad = None
        if optimizer is not None:
            _change_moments(parameter, optimizer, lambda moment: moment[keep])


def append_rows(parameters: Mapping[str, nn.Parameter], optimizer: torch.optim.Adam, new: Mapping[str, Tensor]) -> None:
    """Append rows [M, ...] to every parameter [N, ...] of the same name; the Adam moments of new rows are 0."""
    for name, parameter in parameters.items():
        rows = new[name].detach().to(parameter)
        parameter.data = torch.cat((parameter.data, rows))
        parameter.grad = None
        none = torch.zeros_like(rows)
        _change_moments(parameter, optimizer, lambda moment, none=none: torch.cat((moment, none)))


def forget_moments(parameter: nn.Parameter, optimizer: torch.optim.Adam) -> None:
    """Set the Adam moments of a parameter to 0, if it has any."""
    _change_moments(parameter, optimizer, Tensor.zero_)


def _change_moments(parameter: nn.Parameter, optimizer: torch.optim.Adam, change: Callable[[Tensor], Tensor]) -> None:
    moments = optimizer.state.get(parameter, {})
    moments.update({name: change(moments[name]) for name in MOMENTS if name in moments})


def load_rows(model: nn.Module, tensors: Mapping[str, Tensor], growing: Collection[str]) -> None:
    """Load another model's `state_dict`, with other row counts if `growing`; a ValueError for other shapes."""
    count = len(tensors[first]) if (first := next(iter(growing))) in tensors else 0
    for name, own in model.state_dict().items():
        shape = [count, *own.shape[1:]] if name in growing else list(own.shape)
        given = list(tensors[name].shape) if name in tensors else None
        if given != shape:
            raise ValueError(f"{name} of the stored model has shape {given}; with these options it is {shape}")
    for name, parameter in model.named_parameters():
        parameter.data = tensors[name].to(parameter).clone()
        parameter.grad = None


class PlainAdam(torch.optim.Adam):
    """Adam without the wrappers for `torch.compile`, whose first call imports torch._dynamo: 4 s of CPU time a run."""

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))


class Optimizer:
    """Adam with a learning rate per parameter group, and checks for values that are not finite.

    `adam` is the torch optimizer, whose rows densification edits; `pace` is that of the learning rates in the last
    step, None before the first, and for published rates.
    """

    def __init__(self, groups: Sequence[ParameterGroup], check_every: int, **adam: Any) -> None:
        """Prepare; all values are checked every `check_every` iterations. `adam` are betas and eps."""
        self._groups, self._check_every = groups, check_every
        self.pace: Pace | None = None
        parameters = [{"params": list(group.parameters), "name": group.name} for group in groups]
        self.adam = PlainAdam(parameters, fused=True, **adam)  # fused: 2 to 3 times faster on CPUs

    def parameters(self) -> dict[str, nn.Parameter]:
        """Return all parameters by their names in messages and checkpoints."""
        return {
            group.name if len(group.parameters) == 1 else f"{group.name}[{number}]": parameter
            for group in self._groups
            for number, parameter in enumerate(group.parameters)
        }

    def step(self, step: int, pace: Pace | None = None) -> None:
        """Step Adam at the learning rates of a schedule step, and drop the gradients."""
        self.pace = pace
        for group, settings in zip(self._groups, self.adam.param_groups, strict=True):
            settings["lr"] = group.rate(step, pace)
        # Adam steps from 0 where rows have factors, so that these act on exact steps.
        scaled = [(part, group.row_rates()) for group in self._groups if group.row_rates for part in group.parameters]
        befores = [part.detach().clone() for part, _ in scaled]
        for part, _ in scaled:
            part.data.zero_()
        self.adam.step()
        for (part, factors), before in zip(scaled, befores, strict=True):
            part.data.mul_(factors).add_(before)
        self.adam.zero_grad(set_to_none=True)

    def is_checked(self, iteration: int) -> bool:
        """Return whether all values are checked at an iteration."""
        return iteration % self._check_every == 0

    def check(self, iteration: int) -> None:
        """Check all parameters and gradients if that is due, after `backward`."""
        if self.is_checked(iteration):
            parameters = self.parameters()
            gradients = {f"gradient of {name}": parameter.grad for name, parameter in parameters.items()}
            self.refuse_non_finite({**parameters, **gradients}, iteration)

    def read(self, loss: Tensor, inputs: Mapping[str, Tensor | None], iteration: int) -> float | Tensor:
        """Return the loss, read from a GPU every few iterations only; a Failure (nan) names what is not finite."""
        if loss.device.type != "cpu" and iteration % READ_EVERY and not self.is_checked(iteration):
            return loss.detach()
        if not math.isfinite(value := loss.item()):
            self.refuse_non_finite({**self.parameters(), **inputs, "loss": loss}, iteration)
        return value

    def refuse_non_finite(self, tensors: Mapping[str, Tensor | None], iteration: int) -> None:
        """Raise a Failure (nan) that names the first tensor that is not finite, and its entry."""
        if (bad := first_non_finite(tensors)) is not None:
            often = f"all parameters are checked every {self._check_every} iterations"
            raise Failure("nan", f"{bad} at iteration {iteration} ({often})")

    def tensors(self) -> dict[str, Tensor]:
        """Return the moments of Adam by name; not copies."""
        return {
            f"{ADAM}{name}/{key}": value
            for name, parameter in self.parameters().items()
            for key, value in self.adam.state.get(parameter, {}).items()
        }

    def load(self, state: State) -> None:
        """Load the moments from a whole state; parameters without moments begin without."""
        self.adam.state.clear()
        for name, parameter in self.parameters().items():
            if moments := state.under(f"{ADAM}{name}/"):
                self.adam.state[parameter] = {k: v.to(parameter.device, copy=True) for k, v in moments.items()}


def first_non_finite(tensors: Mapping[str, Tensor | None]) -> str | None:
    """Return name and first entry of the first tensor with a NaN or an infinity; None if all are finite.

    >>> first_non_finite({"a": torch.zeros(2), "b": torch.tensor([[0.0, float("nan")]]), "c": None})
    'b[0, 1] is nan'
    """
    for name, tensor in tensors.items():
        if tensor is None or torch.isfinite(tensor).all():
            continue
        index = (~torch.isfinite(tensor)).nonzero()[0].tolist()
        return f"{name}{index if index else ''} is {tensor[tuple(index)].item()}"
    return None
