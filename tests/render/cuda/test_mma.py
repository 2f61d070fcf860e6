"""Products of tensor cores, those of a GPU or emulated: fragments where PTX has them, numbers rounded as torch does."""

import ctypes
import functools

import pytest
import torch
from support import cuda_engine
from torch import Tensor

from padgs.native.abi import pointer

pytestmark = [
    *cuda_engine.marks(),
    pytest.mark.skipif(cuda_engine.ON_GPU and cuda_engine.NVCC is None, reason="no nvcc to compile the check with"),
]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"
TYPES = (torch.bfloat16, torch.float16)  # in the order of mma_check.cpp's numbers for them


@functools.cache
def library() -> ctypes.CDLL:
    source = cuda_engine.HERE / "mma_check.cpp"
    return cuda_engine.compiled_for_gpu("mma", source) if cuda_engine.ON_GPU else cuda_engine.compiled("mma", [source])


def addresses(*tensors: Tensor) -> list[ctypes.c_void_p]:
    return [ctypes.c_void_p(pointer(tensor)) for tensor in tensors]


@pytest.mark.parametrize("dtype", TYPES)
def test_products_match_rounded_matrices(dtype: torch.dtype, generator: torch.Generator):
    a, b, sums = (torch.randn(*size, generator=generator).to(DEVICE) for size in ((16, 16), (16, 8), (16, 8)))
    expected = sums.double() + a.to(dtype).double() @ b.to(dtype).double()
    library().check_product(TYPES.index(dtype), *addresses(a, b, sums))
    torch.testing.assert_close(sums, expected.float(), atol=1e-6, rtol=1e-6)


def test_transposed_products(generator: torch.Generator):
    a, b = torch.randn(2, 16, 16, generator=generator).to(DEVICE)
    out, rounded = torch.empty(16, 16, device=DEVICE), [matrix.bfloat16().double() for matrix in (a, b)]
    library().check_transposed_product(*addresses(a, b, out))
    torch.testing.assert_close(out, (rounded[0].T @ rounded[1]).float(), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("dtype", TYPES)
def test_numbers_are_rounded_as_torch_rounds_them(dtype: torch.dtype, generator: torch.Generator):
    signs, sizes = torch.randn(1 << 13, generator=generator).sign(), torch.rand(1 << 13, generator=generator)
    ordinary = signs * torch.exp2(300 * sizes - 150)
    every = torch.arange(1 << 15, dtype=torch.int32).to(torch.int16).view(dtype).float()
    ties = ((every + every.roll(-1)) / 2).nan_to_num(0, 3e38, -3e38)
    near = torch.tensor([0.0, -0.0, 65504, 65519.99, 65520, 3.4e38, float("inf"), float("-inf"), float("nan"), 1e-45])
    numbers = torch.cat((ordinary, every, ties, near))
    numbers = torch.cat((numbers, numbers.new_zeros(-len(numbers) % 64))).to(DEVICE)
    out = torch.empty_like(numbers)
    library().check_rounding(TYPES.index(dtype), len(numbers) // 64, *addresses(numbers, out))
    torch.testing.assert_close(out, numbers.to(dtype).float(), atol=0, rtol=0, equal_nan=True)
    assert torch.equal(out.signbit()[numbers == 0], numbers.signbit()[numbers == 0])
