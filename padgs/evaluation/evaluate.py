"""Score renders of test views under a protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict

import torch
from torch import Tensor

from padgs.evaluation.lpips import lpips, weighted_lpips
from padgs.evaluation.lpips_weights import LpipsUnavailable
from padgs.evaluation.metrics import METRICS, sphere_weight
from padgs.evaluation.protocols import Protocol
from padgs.render import Rendering
from padgs.results import Scores
from padgs.scene import View
from padgs.training.failure import Failure

Marks = dict[str, float | None]  # metric -> value; None = missing (no weights, or no pixel that counts)
Also = Callable[[View, Rendering], Marks]  # numbers of a view that take more than its image
OnView = Callable[[View, Tensor, Tensor], None]  # view, truth, image: [H, W, 3] in [0, 1], as they were compared


def evaluate(
    render: Callable[[View], Rendering],
    views: Sequence[View],
    protocol: Protocol,
    *,
    on_view: OnView | None = None,
    also: Also | None = None,
) -> Scores:
    """Render each view and compare it with its image.

    Args:
        render: a trained method's `render`.
        views: the test views; each has an image, and may have a mask.
        protocol: the rules.
        on_view: called with each view, its truth and its render (clamped, 8-bit, not cropped), to save pictures.
        also: gives more marks of each view.

    Raises:
        ValueError: no views, a view without an image, or a render of another size than its view.
        Failure: a render has non-finite values (status nan).
    """
    if not views:
        raise ValueError("no test views to evaluate; give the scene a test split")
    marks: dict[str, Marks] = {}
    notes: dict[str, None] = {}  # as keys: each once, in order
    with torch.no_grad():
        for view in views:
            rendering = render(view)
            image = as_stored(checked(rendering.image, view))
            truth = view.image(dtype=image.dtype, device=image.device)
            mask = view.mask(dtype=image.dtype, device=image.device)
            marks[view.name] = score(image, truth, mask, protocol, notes)
            if also is not None:
                marks[view.name] |= also(view, rendering)
            if on_view is not None:
                on_view(view, truth, image)
    return Scores(asdict(protocol), mean_marks(list(marks.values())), marks, tuple(notes))


def score(
    image: Tensor, truth: Tensor, mask: Tensor | None, protocol: Protocol, notes: dict[str, None] | None = None
) -> Marks:
    """The protocol's metrics of one image [H, W, 3] against the truth, with a weight [H, W] per pixel or None.

    Why LPIPS is missing, where it is, is added to `notes`.
    """
    rows = protocol.rows(image.shape[0])
    if protocol.solid_angle:
        mask = weight_of(mask, image, protocol)
    elif rows < image.shape[0]:
        image, truth, mask = image[:rows], truth[:rows], None if mask is None else mask[:rows]
    marks: Marks = {name: known(METRICS[name](image, truth, mask)) for name in protocol.metrics}
    if protocol.lpips_name is not None:
        try:
            marks[protocol.lpips_name] = known(_lpips(image, truth, mask, protocol))
        except LpipsUnavailable as reason:
            marks[protocol.lpips_name] = None
            if notes is not None:
                notes[f"{protocol.lpips_name} is missing: {reason}"] = None
    return marks


def weight_of(mask: Tensor | None, image: Tensor, protocol: Protocol) -> Tensor | None:
    """A mask [H, W] or None, with the rows of an image [H, W, 3] hidden that do not count.

    Hidden, not cut off: latitude is a matter of the whole image.
    """
    rows = protocol.rows(image.shape[0])
    if rows == image.shape[0]:
        return mask
    counts = torch.arange(image.shape[0], device=image.device) < rows
    return counts[:, None] * (torch.ones_like(image[..., 0]) if mask is None else mask)


def mean_marks(views: Sequence[Marks]) -> Marks:
    """Mean of each metric over the views that have it; None where none has.

    >>> mean_marks([{"psnr": 20.0, "seam": None}, {"psnr": 30.0, "seam": None}])
    {'psnr': 25.0, 'seam': None}
    """
    mean: Marks = {}
    for name in views[0]:
        present = [value for marks in views if (value := marks[name]) is not None]
        mean[name] = sum(present) / len(present) if present else None
    return mean


def as_stored(image: Tensor) -> Tensor:
    """The image as an 8-bit file would give it back: clamped to [0, 1], rounded to 1/255."""
    return (image.clamp(0, 1) * 255).round() / 255


def checked(image: Tensor, view: View) -> Tensor:
    """The image, if it is one of this view that can be scored.

    Raises:
        ValueError: another size than the view's.
        Failure: non-finite values; clamping would turn them into black and score that.
    """
    if tuple(image.shape) != (view.height, view.width, 3):
        raise ValueError(
            f"render of {view.name!r} has shape {tuple(image.shape)}; the view is {view.height}x{view.width}x3"
        )
    bad = int((~torch.isfinite(image)).sum())
    if bad:
        raise Failure("nan", f"render of view {view.name!r} has {bad} non-finite values")
    return image


def _lpips(image: Tensor, truth: Tensor, mask: Tensor | None, protocol: Protocol) -> Tensor:
    net, inputs = protocol.lpips, protocol.lpips_inputs
    if not protocol.solid_angle:
        return lpips(image, truth, mask, net=net, inputs=inputs)
    return weighted_lpips(image, truth, sphere_weight(image, mask), mask=mask, net=net, inputs=inputs)


def known(metric: Tensor) -> float | None:
    """A metric as a number; None where no pixel counts."""
    value = metric.item()
    return None if value != value else value  # images are finite, so NaN only says that no pixel counts
