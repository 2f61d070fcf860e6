"""Evaluation of renders of test views under a protocol."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict

import torch
from torch import Tensor

from padgs.evaluation.lpips import LpipsUnavailable, lpips
from padgs.evaluation.metrics import METRICS, PHOTOGRAPH_METRICS, sphere_weight
from padgs.evaluation.protocols import Protocol
from padgs.geometry.camera import Camera, pixel_solid_angles
from padgs.render import Rendering
from padgs.results import Scores
from padgs.scene import View
from padgs.training.health import Failure

MOST_DECIBELS = 100.0  # of a view in the mean over views

Metrics = dict[str, float | None]  # metric -> value; None = missing (no LPIPS weights, or no weighted pixel)
ExtraMetrics = Callable[[View, Rendering], Metrics]  # metrics that need more than the image
OnView = Callable[[View, Tensor, Tensor], None]  # view, truth, image: [H, W, 3] in [0, 1], as compared


def evaluate(
    render: Callable[[View], Rendering],
    views: Sequence[View],
    protocol: Protocol,
    *,
    on_view: OnView | None = None,
    extra: ExtraMetrics | None = None,
) -> Scores:
    """Render each test view and compare it with its ground truth; a Failure (nan) if a render is not finite.

    `on_view` receives each view, truth and render (8-bit, not cropped), to save images; `extra`: further metrics.
    """
    if not views:
        raise ValueError("no test views to evaluate; give the scene a test split")
    metrics: dict[str, Metrics] = {}
    notes: dict[str, None] = {}  # keys: each once, in order
    with torch.no_grad():
        for view in views:
            rendering = render(view)
            image = quantized(checked(rendering.image, view))
            truth = view.image(dtype=image.dtype, device=image.device)
            mask = view.mask(dtype=image.dtype, device=image.device)
            metrics[view.name] = score(image, truth, mask, protocol, notes, camera=view.lens)
            if extra is not None:
                metrics[view.name] |= extra(view, rendering)
            if on_view is not None:
                on_view(view, truth, image)
    return Scores(asdict(protocol), mean_metrics(list(metrics.values())), metrics, tuple(notes))


def score(
    image: Tensor,
    truth: Tensor,
    mask: Tensor | None,
    protocol: Protocol,
    notes: dict[str, None] | None = None,
    *,
    camera: Camera | None = None,
) -> Metrics:
    """Return metrics of an image [H, W, 3] with a mask [H, W] or None; `notes` receives why LPIPS is missing.

    `camera` is that of a photograph, which is not cropped and has no metrics of latitudes and of a seam.
    """
    rows = protocol.rows(image.shape[0]) if camera is None else image.shape[0]
    if camera is None and protocol.solid_angle:
        mask = cropped_mask(mask, image, protocol)
    elif rows < image.shape[0]:  # a mask that hides the cut rows alone is left out: LPIPS is then the usual one
        image, truth, mask = image[:rows], truth[:rows], None if mask is None or mask[:rows].min() == 1 else mask[:rows]
    weight = angle_weight(image, mask, camera)
    metrics: Metrics = dict.fromkeys(protocol.metrics)
    measures = METRICS if camera is None else PHOTOGRAPH_METRICS
    for name in metrics.keys() & measures.keys():
        shown = weight if camera is not None and name.startswith("ws_") else mask
        metrics[name] = finite_or_none(measures[name](image, truth, shown))
    if protocol.lpips_name is not None:
        try:
            weight = weight if protocol.solid_angle else None
            value = lpips(image, truth, mask, weight=weight, net=protocol.lpips, inputs=protocol.lpips_inputs)
            metrics[protocol.lpips_name] = finite_or_none(value)
        except LpipsUnavailable as reason:
            metrics[protocol.lpips_name] = None
            if notes is not None:
                notes[f"{protocol.lpips_name} is missing: {reason}"] = None
    return metrics


def angle_weight(image: Tensor, mask: Tensor | None, camera: Camera | None) -> Tensor:
    """Return the solid angle of each pixel times its mask, [H, W], of a photograph's camera or a panorama (None)."""
    if camera is None:
        return sphere_weight(image, mask)
    angles = (pixel_solid_angles(camera) * camera.focal**2).to(image)
    return angles if mask is None else angles * mask


def cropped_mask(mask: Tensor | None, image: Tensor, protocol: Protocol) -> Tensor | None:
    """Return the mask [H, W] with 0 below the protocol's crop, as latitude refers to the whole image; None: no mask."""
    rows = protocol.rows(image.shape[0])
    if rows == image.shape[0]:
        return mask
    counts = torch.arange(image.shape[0], device=image.device) < rows
    return counts[:, None] * (torch.ones_like(image[..., 0]) if mask is None else mask)


def mean_metrics(views: Sequence[Metrics]) -> Metrics:
    """Return the mean of each metric over the views that have it; None if none has.

    An exact view counts as `MOST_DECIBELS`, or an infinite mean would hide the other views.

    >>> mean_metrics([{"psnr": 20.0, "seam": None}, {"psnr": 30.0, "seam": None}])
    {'psnr': 25.0, 'seam': None}
    """
    mean: Metrics = {}
    for name in dict.fromkeys(name for metrics in views for name in metrics):
        most = MOST_DECIBELS if "psnr" in name else math.inf
        present = [min(value, most) for metrics in views if (value := metrics.get(name)) is not None]
        mean[name] = sum(present) / len(present) if present else None
    return mean


def quantized(image: Tensor) -> Tensor:
    """Return the image as stored in an 8-bit file: clamped to [0, 1], rounded to 1/255."""
    return (image.clamp(0, 1) * 255).round() / 255


def checked(image: Tensor, view: View) -> Tensor:
    """Return the image; ValueError for another size than the view's, Failure for non-finite values."""
    if tuple(image.shape) != (view.height, view.width, 3):
        shape = tuple(image.shape)
        raise ValueError(f"render of {view.name!r} has shape {shape}; the view is {view.height}x{view.width}x3")
    bad = int((~torch.isfinite(image)).sum())
    if bad:
        raise Failure("nan", f"render of view {view.name!r} has {bad} non-finite values")
    return image


def finite_or_none(metric: Tensor) -> float | None:
    """Return a metric as a number; None for NaN: no weighted pixel, or 0 / 0 such as `seam` of an exact render."""
    value = metric.item()
    return None if value != value else value
