"""The photometric loss (Eq. 16) and the SSIM map it is made of.

loss = lambda <|image - target|> + (1 - lambda) <1 - SSIM>, where <.> is the mean over pixels and channels weighted by
W = row weight M (Eq. 17) x mask. Pixels that a mask hides have weight 0. SSIM windows that reach them see the target in
both images, so that no gradient comes from hidden pixels.
"""

import ctypes
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.geometry.distortion import end_row_weight, solid_angle_weight
from padgs.geometry.panorama import Device
from padgs.native import cpu, cuda, library_for
from padgs.native.abi import LossArguments, pointer

WINDOW, SIGMA = 11, 1.5  # SSIM window in pixels
C1, C2 = 0.01**2, 0.03**2
NORMALISATIONS = ("mean", "channel_sum")
SQUARES_SHARE = 0.4  # of a run, at its end, in which squared errors count if they do
MEASURED, MONOCULAR = DEPTH_KINDS = ("measured", "monocular")

ROW_WEIGHTS = {
    "solid_angle": solid_angle_weight,  # M = cos(latitude) of the row's centre
    "uniform": torch.ones,  # M = 1
    "end_rows": end_row_weight,  # the released code's M, 0 in the first and last row
}


def photometric_loss(
    image: Tensor, target: Tensor, weight: Tensor, lambda_l1: float = 0.8, *, normalisation: str = "mean"
) -> Tensor:
    """Return Eq. 16, a scalar; differentiable by `image`, and by `target` if it requires a gradient.

    Args:
        image, target: [H, W, 3], not clamped.
        weight: [H, W], or [H, 1] where all pixels of a row weigh the same; >= 0, not 0 everywhere.
        lambda_l1: lambda of Eq. 16.
        normalisation: mean divides by 3 sum(W); channel_sum by sum(W), as the released code does (3 x the mean).
    """
    height, width, channels = image.shape
    if weight.shape == (height, width):  # with a mask
        visible, filling = weight[..., None] > 0, target.detach()
        image = torch.where(visible, image, filling)
        target = torch.where(visible, target, filling) if target.requires_grad else target
    total = weight.sum() * (height * width // weight.numel() * (channels if normalisation == "mean" else 1))
    if channels == 3 and library_for(image) is not None:
        loss = fused_photometric_loss(image, target.detach(), weight, lambda_l1, total)
        if target.requires_grad:  # Eq. 16 is symmetric: exchange both to differentiate by the target
            mirrored = fused_photometric_loss(target, image.detach(), weight, lambda_l1, total)
            loss = loss + (mirrored - mirrored.detach())
        return loss
    per_channel = lambda_l1 * (image - target).abs() + (1 - lambda_l1) * (1 - ssim_map(image, target))
    return (weight[..., None] * per_channel).sum() / total


def inverse_range_loss(depth: Tensor, truth: Tensor, weight: Tensor, unit: float, kind: str = MEASURED) -> Tensor:
    """Return the weighted mean of |unit / depth - unit / truth| over pixels with a known truth, a scalar.

    Inverse ranges of far surfaces, whose range is the least certain, differ least. Differentiable by `depth` [H, W] of
    a render, where pixels in which nothing is drawn, 0, are left out. `truth` [H, W]: 0, NaN or negative is unknown,
    inf the sky; `weight` is [H, W] or [H, 1], `unit` a length that makes inverse ranges plain numbers, such as the
    scene scale. With `kind` monocular, a scale and a shift of the inverse truth are fitted to the render by least
    squares; the loss is 0 if that turns near and far around.
    """
    known = (truth > 0) & (depth > 0)
    weight = (weight * known) / (weight * known).sum().clamp(min=1e-12)
    rendered, inverse = unit / torch.where(known, depth, unit), unit / torch.where(known, truth, unit)
    if kind == MONOCULAR:
        given, drawn = (values - (weight * values).sum() for values in (inverse, rendered.detach()))
        slope = (weight * given * drawn).sum() / (weight * given * given).sum().clamp(min=1e-12)
        inverse = slope.clamp(min=0) * given + (weight * rendered.detach()).sum()
        weight = weight * (slope > 0)
    return (weight * (rendered - inverse).abs()).sum()


def squared_error(image: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Return the mean squared difference of images [H, W, 3], weighted by [H, W] or [H, 1], a scalar."""
    weight = weight.expand(image.shape[:2])
    return (weight * (image - target).square().mean(-1)).sum() / weight.sum()


def pixel_weight(
    name: str, height: int, mask: Tensor | None = None, *, dtype: torch.dtype = torch.float32, device: Device = "cpu"
) -> Tensor:
    """Return W of Eq. 16: row weight `name` times the mask, [H, W], or [H, 1] without; a mask of 0 is a ValueError."""
    rows = ROW_WEIGHTS[name](height, dtype=dtype, device=device)[:, None]
    if mask is None:
        return rows
    if not ((weight := rows * mask.to(rows)) > 0).any():
        raise ValueError("the mask is 0 everywhere, or wherever pixels count; correct the mask or remove the view")
    return weight


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return the structural similarity [H, W, C]; zeros outside the image, no wrap; variances are E[x^2] - E[x]^2."""
    images = torch.stack((image, image * image, image * target, target, target * target))
    mean_image, square_image, product, mean_target, square_target = window_mean(images)
    cross, squares = mean_image * mean_target, mean_image * mean_image
    variance = square_target - mean_target * mean_target
    similarity = (2 * cross + C1) * (2 * (product - cross) + C2)
    return similarity / ((squares + mean_target**2 + C1) * (square_image - squares + variance + C2))


def window_mean(images: Tensor) -> Tensor:
    """Return the mean of each pixel's neighbourhood under the Gaussian window, [B, H, W, C]; zeros outside."""
    return _blur(_blur(images, dim=1), dim=2)


def _blur(images: Tensor, dim: int) -> Tensor:
    # A sum of shifted copies: on CPUs 2.5 x faster than a grouped conv2d, and the same code for every dtype and device.
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    taps = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    taps = (taps / taps.sum()).tolist()
    size, half = images.shape[dim], WINDOW // 2
    result = images * taps[half]
    for step in range(1, min(half + 1, size)):
        result.narrow(dim, 0, size - step).add_(images.narrow(dim, step, size - step), alpha=taps[half + step])
        result.narrow(dim, step, size - step).add_(images.narrow(dim, 0, size - step), alpha=taps[half - step])
    return result


def fused_photometric_loss(image: Tensor, target: Tensor, weight: Tensor, lambda_l1: float, total: Tensor) -> Tensor:
    """Return Eq. 16 over float32 tensors on one device, differentiable by `image`, by the native library.

    Arguments are as in `photometric_loss`; the weighted sum over pixels and channels is divided by `total`, a scalar.
    """
    if (target.shape, target.dtype) != (image.shape, image.dtype):  # the library gets bare pointers
        raise ValueError(
            f"the target is {target.dtype} of {list(target.shape)}, the image {image.dtype} of {list(image.shape)}; "
            "give both alike"
        )
    devices = {str(tensor.device): None for tensor in (image, target, weight, total)}
    if len(devices) > 1:
        raise ValueError(f"image, target, weight and total are on {', '.join(devices)}; bring them to one device")
    height, width, _ = image.shape
    drawn, target = image.detach().contiguous(), target.contiguous()
    weight = weight.to(torch.float32).expand(height, width)

    def evaluate(gradient: Tensor | None) -> Tensor:
        arguments = LossArguments(width, height, pointer(drawn), pointer(target), weight.data_ptr(), *weight.stride())
        arguments.lambda_l1, arguments.gradient = lambda_l1, pointer(gradient)
        return EVALUATIONS[drawn.device.type](arguments, drawn, total)

    return WithDerivative.apply(image, evaluate)


class WithDerivative(torch.autograd.Function):
    """Scalar that a library computes together with its derivative by a tensor; a call fills that unless it is None."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, call: Callable[[Tensor | None], Tensor]) -> Tensor:
        """Return the scalar."""
        ctx.gradient = tensor.new_empty(tensor.shape) if ctx.needs_input_grad[0] else None
        return call(ctx.gradient)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        """Return the gradient of the tensor."""
        return ctx.gradient * grad, None


def _on_cpu(arguments: LossArguments, image: Tensor, total: Tensor) -> Tensor:
    scratch = cpu.workspace("padgs_loss_workspace", *image.shape[:2])
    arguments.normalizer, arguments.workspace = 1 / float(total), pointer(scratch)
    return image.new_tensor(cpu.library().padgs_photometric_loss(ctypes.byref(arguments)))


def _on_gpu(arguments: LossArguments, image: Tensor, total: Tensor) -> Tensor:
    """Evaluate without waiting for the GPU: divisor and loss stay on the device."""
    height, width, _ = image.shape
    total = total.to(torch.float32)
    partials = None if arguments.gradient is None else image.new_empty(3, height, width, 3)
    sums = image.new_empty(cuda.library().padgs_cuda_loss_blocks(height, width))
    arguments.workspace = pointer(partials)
    device_arguments = cuda.DeviceLossArguments(arguments, pointer(total), pointer(sums))
    cuda.call("padgs_cuda_photometric_loss", cuda.queue(image.device), device_arguments)
    return (sums.sum(dtype=torch.float64) / total).to(torch.float32)


EVALUATIONS = {"cpu": _on_cpu, "cuda": _on_gpu}  # by the type of the device
