"""Score a trained method on the test views, and time it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from itertools import cycle, islice
from typing import Any

from padgs.clock import summary, timed
from padgs.evaluation.diagnostics import diagnose, oracle, pole_gap
from padgs.evaluation.evaluate import Metrics, OnView, cropped_mask, evaluate, finite_or_none, quantized
from padgs.evaluation.metrics import mean_color, psnr, ws_psnr_fitted
from padgs.evaluation.protocols import Protocol
from padgs.geometry.panorama import row_latitudes
from padgs.render import Rendering
from padgs.results import Scores
from padgs.scene import Scene, View
from padgs.training.method import Method

POLAR = 85.0  # degrees
STABILITY = "stability"  # the protocol that has more than image metrics
FRAMES = 10  # timed at least, and each test view once


def scores(
    method: Method, scene: Scene, protocols: dict[str, Protocol], save_picture: OnView | None
) -> dict[str, Scores]:
    """The marks of the test views under each protocol; pictures are saved once."""
    found = {}
    for name, protocol in protocols.items():
        scored = stability if name == STABILITY else evaluated
        found[name] = scored(method, scene, protocol, None if found else save_picture)
    return found


def evaluated(method: Method, scene: Scene, protocol: Protocol, on_view: OnView | None) -> Scores:
    """The marks of the test views under a protocol."""
    return evaluate(method.render, scene.test, protocol, on_view=on_view)


def stability(method: Method, scene: Scene, protocol: Protocol, on_view: OnView | None) -> Scores:
    """The same, and besides: geometry (`padgs.evaluation.diagnostics`), the WS-PSNR of one colour, of training views, and
    after colours were fitted, and the pole gap of an oracle (`padgs.evaluation.diagnostics`).
    """

    def also(view: View, rendering: Rendering) -> Metrics:
        truth, image = view.image(device=rendering.image.device), quantized(rendering.image)
        mask = cropped_mask(view.mask(device=image.device), image, protocol)
        marks = {"ws_psnr_one_color": mean_color(truth, mask), "ws_psnr_fitted": ws_psnr_fitted(image, truth, mask)}
        if view.lens is None and (blurred := oracle(image, truth, mask)) is not None:
            marks["pole_gap_oracle"] = pole_gap(blurred, truth, mask)
        marks = {"pole_gap_oracle": None, **{name: finite_or_none(mark) for name, mark in marks.items()}}
        return {**marks, **diagnose(method.render, view, rendering)}

    found = evaluate(method.render, scene.test, protocol, on_view=on_view, extra=also)
    seen = scene.train[:: max(1, len(scene.train) // len(scene.test))]
    own = evaluate(method.render, seen, protocol).metrics["ws_psnr"]
    return replace(found, metrics={**found.metrics, "ws_psnr_training": own})


def quality_of_one_color(scene: Scene, protocol: Protocol) -> float:
    """Mean WS-PSNR of the test views under a protocol if each were of one colour, in dB."""

    def quality(view: View) -> float:
        truth = view.image()
        return mean_color(truth, cropped_mask(view.mask(), truth, protocol)).item()

    return sum(map(quality, scene.test)) / len(scene.test)


def probe(method: Method, view: View) -> dict[str, float]:
    """What one test view says while a method is trained: psnr in dB, of all pixels that its mask lets through; and
    polar_transmittance, the mean share of the background in the rows beyond `POLAR` degrees of latitude (of a tiny
    image the first and the last), where modulated opacities may let it shine through.
    """
    rendering = method.render(view)
    image = rendering.image.clamp(0, 1)
    like: dict[str, Any] = {"dtype": image.dtype, "device": image.device}
    latitudes = row_latitudes(view.height, device=image.device).abs()
    polar = latitudes >= min(math.radians(POLAR), latitudes.max().item())
    return {
        "psnr": psnr(image, view.image(**like), view.mask(**like)).item(),
        "polar_transmittance": rendering.transmittance[polar].mean().item(),
    }


def frame_times(method: Method, scene: Scene) -> dict[str, float]:
    """Milliseconds per rendered test view, decoding included, after one view that does not count."""
    method.render(scene.test[0])
    views = islice(cycle(scene.test), max(FRAMES, len(scene.test)))
    device = scene.points.device
    times = summary([timed(lambda view=view: method.render(view), device)[1] for view in views])
    return {f"render_ms_{name}": 1000 * seconds for name, seconds in times.items()}


def same_rules(scores: Scores, protocol: Protocol) -> bool:
    """Whether marks were given under exactly these rules."""
    return json.dumps(asdict(protocol), sort_keys=True) == json.dumps(scores.protocol, sort_keys=True)
