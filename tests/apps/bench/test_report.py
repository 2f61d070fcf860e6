"""One small run from end to end: everything is measured, consistent, and written."""

import json
import math
from dataclasses import replace

import pytest
import torch
from support.pretended_gpu import GPU, pretended_gpu
from typer.testing import CliRunner

from padgs.apps.bench import report
from padgs.apps.bench.report import QUICK, lines
from padgs.apps.bench.stages import STAGES
from padgs.apps.bench.workload import SIGMA, SIZES, Size, build, resident
from padgs.cli.commands import app
from padgs.native import cpu

needs_library = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Return the report of `padgs bench --quick`, and its output."""
    if not cpu.available():
        pytest.skip("the native library is not built")
    folder, threads = tmp_path_factory.mktemp("bench"), torch.get_num_threads()
    done = CliRunner().invoke(app, ["bench", "--quick", "--out", str(folder)], env={"COLUMNS": "160"})
    assert done.exit_code == 0, done.output
    assert torch.get_num_threads() == threads
    return json.loads((folder / "bench.json").read_text()), done.output


@pytest.mark.slow
def test_all_stages_are_measured_above_their_floors_with_the_counters_of_the_workload(bench):
    size, ceilings = bench[0]["sizes"]["quick"], bench[0]["ceilings"]
    assert list(size["stages"]) == list(STAGES) and min(ceilings["arithmetic"], ceilings["memory"]) > 1e8
    for name, timing in size["stages"].items():
        assert timing["seconds"] > 0 and timing["wall"] > 0, name
        # Far above the ceiling, the model or the clock is wrong; a busy machine measures too low ceilings.
        assert timing.get("floor", 0) / timing["seconds"] < 3, name
    assert 0 < size["floor"] < size["iteration"]["cpu"]["min"]
    counters = size["counters"]
    assert counters["gaussians"] == pytest.approx(SIZES["quick"].gaussians, rel=0.05)
    assert counters["contributing"] <= counters["evaluated"]
    assert counters["visible"] <= counters["gaussians"] and counters["visible"] <= counters["instances"]
    assert counters["evaluated_per_pixel"] == counters["evaluated"] / (size["width"] * size["height"])


@pytest.mark.slow
def test_noise_is_stated_first(bench):
    made, text = bench
    assert made["noisy"] == (made["noise"]["worst"] > 0.25) == text.startswith("NOISY")
    assert made["machine"]["compiled_for"] in text


@needs_library
def test_a_gpu_has_the_same_report_with_kernels_and_each_size_is_written(monkeypatch, tmp_path):
    monkeypatch.setattr(report, "cpu_stages", lambda *_: {"blend_kernel": {"seconds": 0.5, "calls": 2.0}})
    monkeypatch.setitem(SIZES, "quick", Size(32, 16, 50))
    written, file = [], tmp_path / "new" / "bench.json"
    floors = report.add_floors  # added after the sizes
    monkeypatch.setattr(report, "add_floors", lambda *a: written.append(file.read_text()) or floors(*a))
    made = report.measure_all(replace(QUICK, repeats=1), file=file)
    assert [set(json.loads(text)["sizes"]) for text in written] == [{"quick"}]
    assert json.loads(file.read_text()) == json.loads(json.dumps(made))
    text = [line for line in lines(made | {"machine": made["machine"] | {"gpu": "Some GPU"}}) if isinstance(line, str)]
    assert "Some GPU" in text[1] and "ceilings of the GPU" in text[1]


def test_a_workload_is_seeded_and_as_large_as_requested():
    first, again, other = (build(Size(256, 128, 5000), seed) for seed in (1, 1, 2))
    assert torch.equal(first.model.positions, again.model.positions)
    assert not torch.equal(first.model.positions, other.model.positions)
    with torch.no_grad():
        gaussians = first.model.decode(first.view).gaussians
    pixels = gaussians.scales / gaussians.means.norm(dim=-1, keepdim=True) * 256 / (2 * math.pi)
    assert len(gaussians) == pytest.approx(5000, rel=0.1)
    assert float(pixels.median()) == pytest.approx(SIGMA, rel=0.05)


def test_a_resident_scene_has_poses_and_panoramas_on_the_device():
    with pretended_gpu() as waits:
        scene = resident(build(SIZES["quick"]).scene, GPU)
        waits.clear()
        for view in scene.train:
            assert view.cam_from_world.device == GPU and view.image(device=GPU).device == GPU
        assert not waits, "nothing is uploaded"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"device": "gpu"}, "unknown device 'gpu'; known: cpu, cuda"),
        ({"repeats": 0}, "repeats is 0; it must be at least 1"),
        ({"threads": 0}, "threads is 0; it must be at least 1"),
    ],
)
def test_wrong_options_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        replace(QUICK, **wrong)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_errors_name_the_missing_gpu_and_the_folder(tmp_path):
    (tmp_path / "file").write_text("")
    for folder, device, message in (
        ("bench", "cuda", "torch finds no GPU with a driver"),
        ("file/below", "cpu", "below"),
    ):
        done = CliRunner().invoke(app, ["bench", "--quick", "--device", device, "--out", str(tmp_path / folder)])
        assert done.exit_code == 1 and message in " ".join(done.output.split())
