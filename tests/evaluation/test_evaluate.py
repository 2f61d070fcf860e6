import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from support.tiny_scene import tiny_scene

from padgs.evaluation import evaluate as module
from padgs.evaluation import scoring
from padgs.evaluation.evaluate import MOST_DECIBELS, evaluate, mean_metrics, quantized, score
from padgs.evaluation.lpips import LpipsUnavailable
from padgs.evaluation.metrics import METRICS, psnr, ssim, ws_psnr
from padgs.evaluation.protocols import PROTOCOLS
from padgs.render import Rendering
from padgs.scene import View
from padgs.training.health import Failure

H, W = 32, 64
PAPER = replace(PROTOCOLS["paper"], lpips="none")
SPHERE = replace(PROTOCOLS["sphere"], lpips="none")


def view(name: str, pixels: torch.Tensor | None, mask: torch.Tensor | None = None) -> View:
    return View(
        name,
        torch.eye(4, dtype=torch.float64),
        W,
        H,
        load_pixels=None if pixels is None else lambda: pixels,
        load_mask=None if mask is None else lambda: mask,
    )


def rendering(image: torch.Tensor) -> Rendering:
    return Rendering(image, torch.zeros(H, W), torch.zeros(H, W), torch.zeros(0, dtype=torch.bool))


@pytest.fixture
def pixels(generator):
    return torch.randint(0, 256, (H, W, 3), generator=generator, dtype=torch.uint8)


@pytest.fixture
def image(generator, pixels):
    """A render with values beyond [0, 1]."""
    return pixels / 255 + 0.2 * torch.randn(H, W, 3, generator=generator)


def test_scores_are_those_of_saved_8_bit_images(tmp_path, image, pixels):
    evaluation = evaluate(lambda _: rendering(image), [view("a", pixels)], PAPER)
    Image.fromarray((image.clamp(0, 1) * 255).round().byte().numpy()).save(tmp_path / "render.png")
    stored = torch.from_numpy(np.array(Image.open(tmp_path / "render.png"))) / 255
    assert evaluation.views["a"]["psnr"] == psnr(stored, pixels / 255).item()
    assert evaluation.views["a"]["ssim"] == ssim(stored, pixels / 255).item()
    assert evaluation.views["a"]["psnr"] != pytest.approx(psnr(image, pixels / 255).item(), abs=1e-3)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_perfect_render(name, pixels):
    protocol = PROTOCOLS[name]
    evaluation = evaluate(lambda _: rendering(pixels / 255), [view("a", pixels)], protocol)
    for metric, value in evaluation.metrics.items():
        if "psnr" in metric:
            assert value == MOST_DECIBELS and evaluation.views["a"][metric] == math.inf, metric
        elif "ssim" in metric:
            assert value == pytest.approx(1.0), metric
        elif metric == "seam":
            assert value is None  # nothing to compare with
        elif value is not None:  # LPIPS, where there are weights
            assert value == 0, metric
    lpips = [] if protocol.lpips_name is None else [protocol.lpips_name]
    assert [*evaluation.metrics] == [*protocol.metrics, *lpips]


def test_means_and_images_of_several_views(image, pixels):
    views = [view("a", pixels), view("b", pixels.flip(0))]
    seen = []
    evaluation = evaluate(
        lambda wanted: rendering(image if wanted.name == "a" else image + 0.1),
        views,
        PAPER,
        on_view=lambda *arguments: seen.append(arguments),
    )
    assert [arguments[0] for arguments in seen] == views
    for seen_view, truth, shown in seen:
        assert torch.equal(truth, seen_view.image())
        assert torch.equal(shown, quantized(shown)) and shown.min() >= 0 and shown.max() <= 1
        assert evaluation.views[seen_view.name]["psnr"] == psnr(shown, truth).item()
    a, b = (evaluation.views[name]["psnr"] for name in "ab")
    assert evaluation.metrics["psnr"] == pytest.approx((a + b) / 2)
    assert evaluation.protocol["name"] == "paper" and evaluation.protocol["lpips"] == "none"


@pytest.mark.parametrize("protocol", [PAPER, SPHERE, replace(PROTOCOLS["paper"], lpips="alex")])
def test_masked_pixels_change_no_protocol(image, pixels, generator, protocol):
    mask = torch.ones(H, W)
    mask[-6:] = 0
    ruined = torch.where(mask[..., None] > 0, image, torch.rand(H, W, 3, generator=generator))
    masked = view("a", pixels, mask)
    first, second = (evaluate(lambda _, shown=shown: rendering(shown), [masked], protocol) for shown in (image, ruined))
    assert first.metrics == pytest.approx(second.metrics)
    unmasked = evaluate(lambda _: rendering(ruined), [view("a", pixels)], protocol)
    assert first.metrics["psnr"] != pytest.approx(unmasked.metrics["psnr"], abs=1e-3)


def test_paper_cuts_the_bottom_off_and_sphere_hides_it(image, pixels):
    truth, stored = pixels / 255, quantized(image)
    protocol = replace(PROTOCOLS["paper"], lpips="none", bottom_crop=65 / 1024)
    rows = protocol.rows(H)
    assert rows == 29  # 32 x 959 / 1024 = 29.97
    paper = score(stored, truth, None, protocol)
    assert paper["ssim"] == ssim(stored[:rows], truth[:rows]).item()
    mask = (torch.arange(H) < rows)[:, None].float().expand(H, W)
    sphere = score(stored, truth, None, replace(PROTOCOLS["sphere"], lpips="none", bottom_crop=65 / 1024))
    assert sphere["ws_psnr"] == ws_psnr(stored, truth, mask).item()
    assert sphere["ws_ssim"] == METRICS["ws_ssim"](stored, truth, mask).item()
    assert sphere["ws_psnr_nadir"] is None  # rows 29 to 31


def test_a_mask_of_the_rows_that_are_cut_off_leaves_lpips_as_it_is_without(image, pixels, monkeypatch):
    seen = []

    def found(image, truth, mask, **_):
        seen.append(mask)
        return torch.tensor(0.0)

    monkeypatch.setattr("padgs.evaluation.evaluate.lpips", found)
    protocol = replace(PROTOCOLS["paper"], bottom_crop=65 / 1024)
    mask = (torch.arange(H) < protocol.rows(H))[:, None].float().expand(H, W)
    score(quantized(image), pixels / 255, mask, protocol)
    score(quantized(image), pixels / 255, mask * (torch.arange(W) > 3), protocol)
    assert seen[0] is None and seen[1].shape == (29, W)


def test_metrics_without_weighted_pixels_are_missing(image, pixels):
    mask = torch.ones(H, W)
    mask[H // 2 :] = 0
    views = [view("a", pixels, mask), view("b", pixels)]
    evaluation = evaluate(lambda _: rendering(image), views, SPHERE)
    assert evaluation.views["a"]["ws_psnr_nadir"] is None
    assert evaluation.metrics["ws_psnr_nadir"] == evaluation.views["b"]["ws_psnr_nadir"]
    assert mean_metrics([{"x": None}, {"x": None}]) == {"x": None}


def test_missing_lpips_is_noted_once(image, pixels, monkeypatch):
    def nothing_here(*_, **__):
        raise LpipsUnavailable("no weights for LPIPS vgg")

    monkeypatch.setattr(module, "lpips", nothing_here)
    views = [view("a", pixels), view("b", pixels)]
    evaluation = evaluate(lambda _: rendering(image), views, PROTOCOLS["paper"])
    assert evaluation.notes == ("lpips_vgg_01 is missing: no weights for LPIPS vgg",)
    assert evaluation.metrics["lpips_vgg_01"] is None
    assert evaluation.metrics["psnr"] == pytest.approx(psnr(quantized(image), pixels / 255).item())


def test_renders_that_cannot_be_scored(image, pixels):
    broken = image.clone()
    broken[3, 4, 1] = math.nan
    broken[5, 6, :] = math.inf
    with pytest.raises(Failure, match="view 'a' has 4 non-finite values") as caught:
        evaluate(lambda _: rendering(broken), [view("a", pixels)], PAPER)
    assert caught.value.status == "nan"
    with pytest.raises(ValueError, match=r"shape \(31, 64, 3\); the view is 32x64x3"):
        evaluate(lambda _: rendering(image[1:]), [view("a", pixels)], PAPER)
    with pytest.raises(ValueError, match="view 'a' has a pose but no image"):
        evaluate(lambda _: rendering(image), [view("a", None)], PAPER)
    with pytest.raises(ValueError, match="no test views"):
        evaluate(lambda _: rendering(image), [], PAPER)


def test_frames_are_timed_in_cpu_time_several_times():
    seen = []

    def render(view):
        seen.append(view.name)
        time.sleep(0.01)

    scene = replace(tiny_scene(), test=tiny_scene().train)
    times = scoring.frame_times(render, scene)
    assert [*times] == ["render_ms_min", "render_ms_median"] and times["render_ms_min"] <= times["render_ms_median"] < 5
    assert seen[1:] == scoring.REPEATS * ["00", "02", "04"], "evenly spread, after a warm-up"
