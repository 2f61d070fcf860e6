"""A GPU that there is not: CPU tensors that say they are elsewhere, and that mix with others as little as CUDA's do.

Every operation goes through `Pretence`. It refuses tensors of two devices where CUDA would (numbers, indices and copies
excepted), computes on the CPU, and says that the result is where the operands are. It also counts how often the host
asked for a value, which is when it would wait for a GPU.
"""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

INDEXING = ("index", "index_put", "index_put_", "_index_put_impl_")  # take CPU indices too, like CUDA's
COPYING = ("copy_", "_to_copy")
READING = ("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "_unique2", "masked_select")

IS_REAL = torch.cuda.is_available()  # torch takes one kind of accelerator, and could no longer differentiate on the GPU
if not IS_REAL:
    _setup_privateuseone_for_python_backend("pretended")
    # `torch.utils.checkpoint` asks it, wherever the tensors are.
    torch.get_device_module("pretended").get_amp_supported_dtype = lambda: [torch.float16]
GPU = torch.device("cuda" if IS_REAL else "pretended", 0)


@contextmanager
def pretended_gpu():
    """Provide a device `GPU`; yield the Counter of operations that made the host wait. Skips beside a real GPU."""
    if IS_REAL:
        pytest.skip("a GPU cannot be pretended beside a real one")
    waits: Counter[str] = Counter()
    with _Operations(waits), _Functions(waits):
        yield waits


class OnGPU(Tensor):
    """A CPU tensor that claims to be on the GPU."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> OnGPU:
        """Hold a tensor."""
        self = Tensor._make_wrapper_subclass(
            cls, held.shape, strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype, device=GPU
        )
        self.held = held
        return self

    def __repr__(self, **_: Any) -> str:
        """Return the tensor."""
        return f"OnGPU({self.held!r})"

    def data_ptr(self) -> int:
        """Return the address, for emulated kernels."""
        return self.held.data_ptr()

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        """Refuse operations outside of `pretended_gpu`, whose mode otherwise handles them."""
        with _Operations(Counter()):
            return function(*args, **(kwargs or {}))


class _Operations(TorchDispatchMode):
    def __init__(self, waits: Counter[str]) -> None:
        super().__init__()
        self._waits = waits

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs, name = dict(kwargs or {}), function._schema.name.split("::")[1]
        tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
        there = any(isinstance(tensor, OnGPU) for tensor in tensors)
        if there and name not in COPYING:
            asked = tensors[:1] if name in INDEXING else tensors
            here = [tensor for tensor in asked if not isinstance(tensor, OnGPU) and tensor.dim() > 0]
            zero = all(tensor.dim() == 0 for tensor in tensors if isinstance(tensor, OnGPU))
            if here or (zero and any(not isinstance(tensor, OnGPU) and tensor.dim() > 0 for tensor in tensors)):
                shapes = [(tuple(tensor.shape), str(tensor.device)) for tensor in tensors]
                raise RuntimeError(f"{name} of tensors on two devices: {shapes}")
        if "device" in kwargs and kwargs["device"] is not None:
            on_gpu = torch.device(kwargs["device"]).type == GPU.type
            kwargs["device"] = torch.device("cpu")
        else:
            on_gpu = isinstance(tensors[0], OnGPU) if there and name in (*COPYING, *INDEXING) else there
        sent = name == "_to_copy" and there != on_gpu  # either way; CUDA waits for copies from pageable memory too
        if there and name in INDEXING and any(t.dtype in (torch.bool, torch.uint8) for t in indices_of(args)):
            self._waits["mask"] += 1  # becomes as many numbers as it has ones
        if sent or (name == "copy_" and len({type(t) for t in tensors}) > 1) or (there and name in READING):
            self._waits[name] += 1
        plain_args, plain_kwargs = tree_map(_plain, (args, kwargs))
        result = function(*plain_args, **plain_kwargs)
        known = {id(tensor.held): tensor for tensor in tensors if isinstance(tensor, OnGPU)}

        def named(value: Any) -> Any:
            if id(value) in known:  # changed in place
                return known[id(value)]
            return OnGPU(value) if on_gpu and isinstance(value, Tensor) else value

        return tree_map(named, result)


class _Functions(TorchFunctionMode):
    """Handle calls that torch does not dispatch: tensors from Python numbers, and numbers from tensors."""

    def __init__(self, waits: Counter[str]) -> None:
        super().__init__()
        self._waits = waits

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if function is torch.tensor:
            device = kwargs.pop("device", None) or "cpu"
            return function(*args, **kwargs).to(device)
        if function is Tensor.new_tensor and isinstance(args[0], OnGPU):
            return torch.tensor(*args[1:], **{"dtype": args[0].dtype, **kwargs}).to(GPU)
        if function is Tensor.tolist and isinstance(args[0], OnGPU):
            self._waits["tolist"] += 1
            return args[0].held.tolist()
        if function is Tensor.__format__ and isinstance(args[0], OnGPU):
            return format(args[0].item(), *args[1:])
        if function == Tensor.data.__set__ and isinstance(args[0], OnGPU):
            args[0].held = args[1].held
        if function is Tensor.__getitem__ and isinstance(args[0], OnGPU):
            places = args[1] if isinstance(args[1], tuple) else (args[1],)
            args = args[0], tuple(torch.tensor(place) if isinstance(place, list) else place for place in places)
        return function(*args, **kwargs)


def indices_of(args: tuple) -> list[Tensor]:
    """Return the second argument of an operation of `INDEXING`."""
    return [index for index in args[1] if isinstance(index, Tensor)]


def _plain(value: Any) -> Any:
    return value.held if isinstance(value, OnGPU) else value
