"""Score a trained method on the test views under protocols, and time its rendering."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

from padgs.clock import timed
from padgs.evaluation.diagnostics import depth_scores, diagnose, oracle, pole_gap
from padgs.evaluation.evaluate import Metrics, OnView, angle_weight, cropped_mask, evaluate, finite_or_none, quantized
from padgs.evaluation.metrics import mean_color, psnr, sphere_weight, ws_psnr_fitted
from padgs.evaluation.protocols import Protocol
from padgs.geometry.panorama import row_latitudes
from padgs.render import Rendering
from padgs.results import Scores
from padgs.scene import Scene, View

POLAR = 85.0  # degrees
ONE_COLOR = 60.0  # dB between a view, such as a black frame of a video, and its mean colour
STABILITY = "stability"  # the protocol with more than image metrics
TIMED_VIEWS, REPEATS = 4, 5  # of the frame times
Render = Callable[[View], Rendering]


def score(
    render: Render, scene: Scene, protocols: Mapping[str, Protocol], save: OnView | None, *, calibrates: bool = False
) -> dict[str, Scores]:
    """Return the scores of the test views under each protocol; images are saved under the first one.

    Where training `calibrates`, its views have other poses, exposures or cameras than renders have: no marks of these.
    """
    scores: dict[str, Scores] = {}
    for name, protocol in protocols.items():
        on_view = None if scores else save
        if name == STABILITY:
            scores[name] = _stability(render, scene, protocol, on_view, calibrates)
        elif protocol.solid_angle and any(view.load_depth and not view.depth_is_relative for view in scene.test):
            scores[name] = evaluate(render, scene.test, protocol, on_view=on_view, extra=partial(_depth, protocol))
        else:
            scores[name] = evaluate(render, scene.test, protocol, on_view=on_view)
    return scores


def _depth(protocol: Protocol, view: View, rendering: Rendering) -> Metrics:
    """Return the scores of depth where the protocol and the view's mask count."""
    mask = cropped_mask(view.mask(device=rendering.image.device), rendering.image, protocol)
    return depth_scores(view, rendering, mask)


def _stability(render: Render, scene: Scene, protocol: Protocol, on_view: OnView | None, calibrates: bool) -> Scores:
    """Return image metrics, diagnostics, and WS-PSNR of one colour, after fitting colours, and of training views."""

    def more(view: View, rendering: Rendering) -> Metrics:
        if view.lens is not None:
            return {}
        truth, image = view.image(device=rendering.image.device), quantized(rendering.image)
        mask = cropped_mask(view.mask(device=image.device), image, protocol)
        one_color = mean_color(truth, sphere_weight(truth, mask))
        marks = {"ws_psnr_one_color": one_color, "ws_psnr_fitted": ws_psnr_fitted(image, truth, mask)}
        if (blurred := oracle(image, truth, mask)) is not None:
            marks["pole_gap_oracle"] = pole_gap(blurred, truth, mask)
        marks = {"pole_gap_oracle": None, **{name: finite_or_none(mark) for name, mark in marks.items()}}
        marks |= diagnose(render, view, rendering, mask)
        return marks | {"yaw_error": None} if calibrates else marks  # a learned camera map does not turn with the view

    scores = evaluate(render, scene.test, protocol, on_view=on_view, extra=more)
    training = scene.train[:: max(1, len(scene.train) // len(scene.test))]
    ws_psnr = None if calibrates else evaluate(render, training, protocol).metrics.get("ws_psnr")
    return replace(scores, metrics={**scores.metrics, "ws_psnr_training": ws_psnr})


def constant_color_quality(scene: Scene, protocol: Protocol) -> dict[str, float]:
    """Return the WS-PSNR (dB) of test views that are replaced by their mean colour, without those that have one."""

    def quality(view: View) -> float:
        truth, mask = view.image(), view.mask()
        mask = mask if view.lens is not None else cropped_mask(mask, truth, protocol)
        return mean_color(truth, angle_weight(truth, mask, view.lens)).item()

    found = {view.name: quality(view) for view in scene.test}
    return {name: value for name, value in found.items() if value < ONE_COLOR}


def probe(render: Render, view: View) -> dict[str, float]:
    """Return PSNR and polar transmittance of one test view during training.

    The latter is the mean share of background beyond `POLAR` degrees, where modulated opacities may let it through.
    """
    rendering = render(view)
    image = rendering.image.clamp(0, 1)
    like: dict[str, Any] = {"dtype": image.dtype, "device": image.device}
    latitudes = row_latitudes(view.height, device=image.device).abs()
    polar = latitudes >= min(math.radians(POLAR), latitudes.max().item())
    return {
        "psnr": psnr(image, view.image(**like), view.mask(**like)).item(),
        "polar_transmittance": rendering.transmittance[polar].mean().item(),
    }


def frame_times(render: Render, scene: Scene) -> dict[str, float]:
    """Return the least and the median milliseconds of a frame over some repeats, decoding included, after a warm-up.

    A repeat renders up to `TIMED_VIEWS` test views, evenly spread; times are those of `padgs.clock.timed`.
    """
    views = scene.test[:: -(-len(scene.test) // TIMED_VIEWS)]
    frames = [partial(render, view) for view in views]
    frames[0]()
    device = scene.points.device
    repeats = [sum(timed(frame, device)[1] for frame in frames) / len(frames) for _ in range(REPEATS)]
    return {"render_ms_min": 1000 * min(repeats), "render_ms_median": 1000 * median(repeats)}
