"""Removing, adding and loading rows of per-anchor or per-Gaussian parameters while an Adam optimiser holds them.

The `nn.Parameter` objects keep their identity, so the optimiser, its groups and the model go on referring to them;
their `.data` and Adam moments are replaced, and their gradients are dropped. No graph that was built on the old rows
may be alive when the next one is built.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor, nn

MOMENTS = ("exp_avg", "exp_avg_sq")


def keep_rows(parameters: Mapping[str, nn.Parameter], optimizer: torch.optim.Adam | None, keep: Tensor) -> None:
    """Keep only some rows of every parameter, with their Adam moments if there are any.

    Args:
        parameters: name -> [N, ...], all with the same N.
        keep: [N] bool, or row numbers [M] in the wanted order.

    Raises:
        ValueError: a parameter has another number of rows than `keep`.
    """
    count = _row_count(parameters)
    if keep.dtype == torch.bool and len(keep) != count:
        raise ValueError(f"keep has {len(keep)} entries but the parameters have {count} rows")
    for parameter in parameters.values():
        parameter.data = parameter.data[keep]
        parameter.grad = None
        moments = {} if optimizer is None else optimizer.state.get(parameter, {})
        for name in MOMENTS:
            if name in moments:
                moments[name] = moments[name][keep]


def append_rows(parameters: Mapping[str, nn.Parameter], optimizer: torch.optim.Adam, new: Mapping[str, Tensor]) -> None:
    """Append rows to every parameter; the Adam moments of new rows are 0.

    Args:
        parameters: name -> [N, ...], all with the same N.
        new: the same names -> [M, ...], all with the same M.

    Raises:
        ValueError: a name is missing or unknown, or a shape does not fit; nothing has been changed then.
    """
    _row_count(parameters)
    if new.keys() != parameters.keys():
        raise ValueError(f"new rows are for {sorted(new)} but the parameters are {sorted(parameters)}")
    if len({len(rows) for rows in new.values()}) > 1:
        raise ValueError(f"new rows differ in number: { ({name: len(rows) for name, rows in new.items()}) }")
    for name, parameter in parameters.items():
        if new[name].shape[1:] != parameter.shape[1:]:
            wanted = ["M", *parameter.shape[1:]]
            raise ValueError(f"new rows of {name} have shape {list(new[name].shape)}; it must be {wanted}")
    for name, parameter in parameters.items():
        rows = new[name].detach().to(parameter)
        parameter.data = torch.cat((parameter.data, rows))
        parameter.grad = None
        moments = optimizer.state.get(parameter, {})
        for moment in MOMENTS:
            if moment in moments:
                moments[moment] = torch.cat((moments[moment], torch.zeros_like(rows)))


def forget_moments(parameter: nn.Parameter, optimizer: torch.optim.Adam) -> None:
    """Set the Adam moments of a parameter to 0, if it has any yet."""
    moments = optimizer.state.get(parameter, {})
    for name in MOMENTS:
        if name in moments:
            moments[name].zero_()


def load_rows(model: nn.Module, tensors: Mapping[str, Tensor], growing: Collection[str]) -> None:
    """Set all parameters to what `state_dict` of another model gave, whose `growing` tensors may have other row counts.

    Raises:
        ValueError: a tensor is missing, or has another shape than the options of this model make it.
    """
    count = len(tensors[first]) if (first := next(iter(growing))) in tensors else 0
    for name, own in model.state_dict().items():
        shape = [count, *own.shape[1:]] if name in growing else list(own.shape)
        given = list(tensors[name].shape) if name in tensors else None
        if given != shape:
            raise ValueError(f"{name} of the stored model has shape {given}; with these options it is {shape}")
    for name, parameter in model.named_parameters():
        parameter.data = tensors[name].to(parameter).clone()
        parameter.grad = None


def _row_count(parameters: Mapping[str, nn.Parameter]) -> int:
    counts = {name: len(parameter) for name, parameter in parameters.items()}
    if len(set(counts.values())) != 1:
        raise ValueError(f"parameters must share one number of rows, but have {counts}")
    return next(iter(counts.values()))
