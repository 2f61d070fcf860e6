"""The GPU benchmark, run on the CPU: everything but the events."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
import torch
from pretended_gpu import GPU, pretended_gpu
from typer.testing import CliRunner

from padgs.apps.bench import gpu, on_device, timeline
from padgs.apps.bench.workload import OPTIONS, SIZES, build
from padgs.cli.commands import app
from padgs.methods.splats.trainee import SplatTrainee
from padgs.native import cpu
from padgs.native.loading import Library
from padgs.render import render

needs_native = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")


@pytest.fixture(scope="module")
def report() -> dict:
    return gpu.measure_gpu(("quick",), torch.device("cpu"), repeats=2, warm_up=1)


@needs_native
@pytest.mark.slow
def test_the_report_says_what_was_measured(report: dict):
    size = report["sizes"]["quick"]
    for label in ("ours", "published", "hybrid"):
        part = size[label]
        assert part["backend"] == "cpu"
        assert 0 < part["frame"]["min"] < part["iteration"]["min"]  # of medians one may have been disturbed
        assert part["graph"] is None and set(part["decode"]) == {"float32", "bfloat16", "float16"}
        assert part["counters"]["contributing"] > 0 and part["stages"] == {}  # no call went to libpadgs_cuda
    assert size["published"]["counters"]["instances"] > size["ours"]["counters"]["instances"]
    assert set(size["slower"]) == {"frame", "iteration"} and size["targets"] == {}
    assert report["ceilings"]["copy"] > 0 and report["ceilings"]["fp32"] > 0
    json.dumps(report, allow_nan=False)
    text = "\n".join(gpu.gpu_lines(report))
    assert "quick: 128x64, about 2,000 Gaussians" in text and "published bounds, backend cpu: frame " in text


def test_on_a_gpu_the_frame_is_also_played_back_from_a_graph(monkeypatch: pytest.MonkeyPatch):
    made, poses = [], []
    monkeypatch.setattr(on_device, "CapturedRender", lambda *how: made.append(how) or poses.append)
    iteration = on_device.OnDevice(build(SIZES["quick"]), OPTIONS, torch.device("cpu"))
    assert iteration.captured_frame() is None
    iteration.backend = "cuda"
    draw = iteration.captured_frame()
    assert draw is not None
    draw()
    assert made == [(iteration.work.model.show, iteration.work.view, OPTIONS)]
    assert torch.equal(poses[0], iteration.work.view.cam_from_world)
    part = {
        "backend": "cuda",
        "peak_bytes": None,
        "waits": 1,
        "stages": {},
        "decode": {"float32": {"median": 0.004}},
    } | {
        what: {"median": ms / 1e3, "p95": 1.0}
        for what, ms in {"frame": 5, "iteration": 9, "graph": 2, "explicit": 3}.items()
    }
    size = {"width": 2, "height": 1, "gaussians": 3, **dict.fromkeys(gpu.TITLES, part), "targets": {}}
    machine = {"machine": {"gpu": "G", "cpu": "C"}, "ceilings": {"copy": 1e9, "fp32": 1e12}}
    lines = gpu.gpu_lines({**machine, "sizes": {"quick": size}})
    assert "    iteration of explicit Gaussians: 3.00 ms" in lines
    assert "    frame as a CUDA graph: 2.00 ms" in lines and "    decoded only: 4.00 ms in float32" in lines


def test_decoding_is_timed_in_a_precision_and_leaves_the_model_as_it_was(monkeypatch: pytest.MonkeyPatch):
    iteration, seen = on_device.OnDevice(build(SIZES["quick"]), OPTIONS, torch.device("cpu")), []
    monkeypatch.setattr(iteration.work.model, "decode", lambda _: seen.append(iteration.work.model.options.precision))
    iteration.decoding("float16")()
    assert seen == ["float16"] and iteration.work.model.options.precision == "float32"


def test_explicit_gaussians_are_those_that_are_decoded_and_stay_as_they_are():
    work = build(SIZES["quick"])
    trainer = work.explicit_trainer()
    trainee = trainer._trainee
    assert isinstance(trainee, SplatTrainee)
    with torch.no_grad():
        expected = render(work.model.decode(work.view).gaussians, work.view, OPTIONS).image
    before = trainer.state()
    records = trainer.records()
    for _ in range(2):
        next(records)
    assert torch.allclose(trainee.render(work.view).image, expected, atol=2e-3)
    after = trainer.state().tensors
    assert all(torch.equal(after[name], tensor) for name, tensor in before.tensors.items() if "/splats/" in name)
    assert trainee.splats.active_degree == 3 and after["adam/sh_rest/exp_avg"].any()


def test_what_trains_has_poses_and_panoramas_on_the_device():
    with pretended_gpu() as waits:
        scene = on_device.resident(build(SIZES["quick"]).scene, GPU)
        waits.clear()
        for view in scene.train:
            assert view.cam_from_world.device == GPU and view.image(device=GPU).device == GPU
        assert not waits  # nothing is uploaded any more


@pytest.mark.slow
def test_what_is_measured_is_kept_as_it_comes(monkeypatch: pytest.MonkeyPatch):
    timing = {"frame": {"median": 1.0}, "iteration": {"median": 1.0}}
    monkeypatch.setattr(gpu, "_measure", lambda *_: timing)
    kept = []
    options = {"repeats": 1, "warm_up": 1, "keep": lambda report: kept.append(json.dumps(report))}
    report = gpu.measure_gpu(("quick",), torch.device("cpu"), **options)
    known = [set(json.loads(one)["sizes"]["quick"]) & set(gpu.MEASURED) for one in kept]
    assert known == [{"ours"}, {"ours", "published"}, set(gpu.MEASURED), set(gpu.MEASURED)]
    assert json.loads(kept[-1]) == json.loads(json.dumps(report))


def test_targets_are_judged_for_the_size_that_they_are_stated_for():
    def part(frame: float, iteration: float, peak: float) -> dict:
        times = {"frame": frame, "iteration": iteration, "explicit": iteration / 2}
        return {**{what: {"median": seconds} for what, seconds in times.items()}, "peak_bytes": peak}

    entry = {"ours": part(0.0008, 0.004, 5e9), "slower": {"frame": 3.0, "iteration": 1.5}}
    judged = gpu._targets(SIZES["large"], entry)
    met = {name: verdict["met"] for name, verdict in judged.items()}
    assert met == {
        "frame_ms": True,
        "iteration_ms": False,
        "explicit_ms": True,
        "peak_gb": True,
        "published_slower": False,
    }
    assert gpu._targets(SIZES["medium"], entry) == {}


def test_calls_of_the_library_are_charged_to_stages():
    library = Library(SimpleNamespace(padgs_cuda_bin=lambda: 0, padgs_cuda_pose_blocks=lambda: 1))
    with timeline.calls_watched(timeline.Timeline(torch.device("cpu"))) as marks:
        assert (library.padgs_cuda_bin(), library.padgs_cuda_pose_blocks()) == (0, 1)
    ((name, start, end),) = marks  # the other one asks the host
    assert name == "bin" and start <= end


def test_unknown_sizes_list_the_known_ones():
    with pytest.raises(ValueError, match="unknown size huge; known: quick, small, medium, large"):
        gpu.measure_gpu(("huge",), torch.device("cpu"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_command_says_so(tmp_path):
    result = CliRunner().invoke(app, ["bench", "--device", "cuda", "--quick", "--out", str(tmp_path / "bench")])
    assert result.exit_code == 1 and "torch finds no GPU with a driver" in " ".join(result.output.split())
