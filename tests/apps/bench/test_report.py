"""One small run from end to end: everything is measured, consistent, and written."""

import json
import math
from dataclasses import replace

import pytest
import torch
from typer.testing import CliRunner

from padgs.apps.bench.picture import stacked_bars
from padgs.apps.bench.report import QUICK, BenchOptions
from padgs.apps.bench.stages import STAGES
from padgs.apps.bench.workload import SIGMA, SIZES, Size, build
from padgs.cli.commands import app
from padgs.native import cpu

needs_library = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """The files of `padgs bench --quick`, and what it printed."""
    if not cpu.available():
        pytest.skip("the native library is not built")
    folder, threads = tmp_path_factory.mktemp("bench"), torch.get_num_threads()
    done = CliRunner().invoke(app, ["bench", "--quick", "--out", str(folder)], env={"COLUMNS": "160"})
    assert done.exit_code == 0, done.output
    assert torch.get_num_threads() == threads
    return json.loads((folder / "bench.json").read_text()), (folder / "bench.png").read_bytes(), done.output


@pytest.mark.slow
def test_every_stage_took_time(bench):
    size = bench[0]["sizes"]["quick"]
    assert list(size["stages"]) == list(STAGES)
    for name, timing in size["stages"].items():
        for clock in ("wall", "cpu"):
            assert 0 < timing[clock]["min"] <= timing[clock]["median"] <= timing[clock]["p95"], name


@pytest.mark.slow
def test_the_stages_are_the_whole(bench):
    size = bench[0]["sizes"]["quick"]
    parts = sum(timing["cpu"]["min"] for name, timing in size["stages"].items() if name != "adapt")
    # The least of each stage adds up to no more than the least sum; how much less depends on the neighbours.
    assert 0 < parts <= size["stage_sum"]["cpu"]["min"] * 1.001
    assert size["stage_sum"]["cpu"]["min"] > 0 and size["iteration"]["cpu"]["min"] > 0


@pytest.mark.slow
def test_ceilings_and_floors(bench):
    report = bench[0]
    for ceiling in report["ceilings"].values():
        assert ceiling["per_cpu_second"] > 1e8
    for name, timing in report["sizes"]["quick"]["stages"].items():
        if "floor" in timing:
            # Well above 1, faster than the machine can, the model or the clock is wrong; a busy machine measures its
            # ceilings too low.
            assert 0 < timing["fraction"] < 3, name
            assert timing["bound"] in ("arithmetic", "memory")
    assert report["sizes"]["quick"]["floor"] < report["sizes"]["quick"]["stage_sum"]["cpu"]["min"]


@pytest.mark.slow
def test_counters_are_those_of_the_workload(bench):
    counters, size = bench[0]["sizes"]["quick"]["counters"], SIZES["quick"]
    assert counters["gaussians"] == pytest.approx(size.gaussians, rel=0.05)
    assert counters["contributing"] <= counters["evaluated"]
    assert counters["visible"] <= counters["gaussians"] and counters["visible"] <= counters["instances"]
    assert counters["evaluated_per_pixel"] == counters["evaluated"] / (size.width * size.height)


@pytest.mark.slow
def test_ratios_are_of_the_same_work(bench):
    ratios = bench[0]["ratios"]
    in_torch, of_erp = {"torch_renderer", "torch_decode", "torch_loss"}, {"tangent", "ray", "hybrid", "decode"}
    assert set(ratios) == {"published_bounds", "threads"} | in_torch | of_erp
    for name, ratio in ratios.items():
        assert ratio["cpu"] == ratio["slow"]["cpu"]["min"] / ratio["fast"]["cpu"]["min"] > 0, name
    assert ratios["torch_renderer"]["cpu"] > 30
    assert ratios["published_bounds"]["instances"] > 1
    assert ratios["published_bounds"]["evaluated"] > 1
    assert ratios["ray"]["evaluated"] == ratios["hybrid"]["evaluated"] > 0.5


@pytest.mark.slow
def test_noise_is_judged_and_said(bench):
    report, _, text = bench
    assert report["noisy"] == (report["noise"]["worst"] > 0.25)
    assert ("NOISY" in text) == report["noisy"]
    assert report["machine"]["isa"] in text
    assert "tiles per Gaussian, mean" in text


@pytest.mark.slow
def test_the_picture_is_a_picture(bench):
    assert bench[1].startswith(b"\x89PNG")
    assert len(bench[1]) > 20_000
    assert stacked_bars(bench[0]).startswith(b"\x89PNG")


@needs_library
def test_a_workload_is_seeded_and_as_large_as_asked():
    first, again, other = (build(Size(64, 32, 500), seed) for seed in (1, 1, 2))
    with torch.no_grad():
        counts = [len(work.model.decode(work.view).gaussians) for work in (first, again, other)]
    assert counts[0] == counts[1] == pytest.approx(500, rel=0.1)
    assert torch.equal(first.model.positions, again.model.positions)
    assert not torch.equal(first.model.positions, other.model.positions)


def test_sizes_of_gaussians_are_as_stated():
    work = build(Size(256, 128, 5000))
    with torch.no_grad():
        gaussians = work.model.decode(work.view).gaussians
    pixels = gaussians.scales / gaussians.means.norm(dim=-1, keepdim=True) * 256 / (2 * math.pi)
    assert float(pixels.median()) == pytest.approx(SIGMA, rel=0.05)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sizes": ("huge",)}, "unknown size huge; known: quick, small, medium, large"),
        ({"sizes": ()}, "unknown size"),
        ({"repeats": 0}, "repeats is 0; it must be at least 1"),
        ({"threads": 0}, "threads is 0; it must be at least 1"),
    ],
)
def test_what_cannot_be_measured_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        replace(QUICK, **wrong)
    assert BenchOptions().sizes


@pytest.mark.slow  # imports torch three times
@needs_library
def test_each_instruction_set_that_there_is_gets_its_time():
    from padgs.apps.bench.isas import by_instruction_set

    found = by_instruction_set(Size(64, 32, 200), repeats=1, seed=0)
    assert "baseline" in found and cpu.library().padgs_isa().decode() in found
    assert all(timing["cpu"]["min"] > 0 for timing in found.values())


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    done = CliRunner().invoke(app, ["bench", "--quick", "--out", str(tmp_path / "file" / "below")])
    assert done.exit_code == 1
    assert "below" in done.output
