import gc
import inspect
import io
import json
import os
import shutil
import signal
import weakref
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from rich.console import Console
from support.composed import composed
from support.tiny_scene import HEIGHT, WIDTH, tiny_scene
from support.training import ITERATIONS, folder_of, run, stop_at

from padgs import results
from padgs.checks import ConfigError
from padgs.evaluation import evaluate, lpips
from padgs.evaluation.scoring import probe
from padgs.methods.anchors.method import PaDGSMethod
from padgs.reports import store
from padgs.reports.frame import frame
from padgs.reports.selection import RunSet
from padgs.runs import run as pipeline
from padgs.runs.run import Callback, _joined, build_method, load_scene
from padgs.runs.store import Labels, Progress, RunBusy, RunFolderError, RunStore, labels
from padgs.training.health import Failure
from padgs.training.loop import Record
from padgs.training.options import Budget

PACKAGE = Path(pipeline.__file__).parents[1]


def test_a_run_leaves_all_its_files_and_says_where(config):
    result, said = run(config)
    folder = folder_of(config).path
    assert sorted(p.name for p in folder.iterdir()) == [
        ".lock",
        "checkpoint",
        "config.yaml",
        "log.jsonl",
        "renders",
        "result.json",
    ]
    assert results.read(folder / "result.json") == result
    assert result.status == "ok" and result.iterations_done == ITERATIONS
    assert result.scores["paper"].metrics.keys() == {"psnr", "ssim"}
    assert result.counts["anchors"] > 0 and result.model_bytes > 0 and result.timing["train_seconds"] > 0
    assert result.peak_memory_bytes > 0 and result.peak_device_memory_bytes is None and "on the GPU" not in said
    assert str(folder) in said and "psnr" in said and "anchors" in said
    assert [p.name for p in (folder / "renders").iterdir()] == ["05.png"]
    with Image.open(folder / "renders" / "05.png") as picture:
        assert picture.size == (3 * WIDTH, HEIGHT)


def test_the_memory_of_the_device_that_trains_is_in_the_result(config, monkeypatch):
    asked = []
    peak = {"peak_memory_bytes": 3 * 10**9, "peak_device_memory_bytes": 2 * 10**9}
    monkeypatch.setattr(pipeline.clock, "peak_memory", lambda device: asked.append(device) or peak)
    result, said = run(config)
    assert {*asked} == {torch.device("cpu")}  # where the scene is
    assert (result.peak_memory_bytes, result.peak_device_memory_bytes) == (3 * 10**9, 2 * 10**9)
    assert "peak memory 3.00 GB, 2.00 GB on the GPU" in said


def test_the_log_has_losses_and_the_held_out_view(config):
    run(config)
    lines = [json.loads(line) for line in (folder_of(config).path / "log.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [2, 4, 5, 6, 8, 10, 12]
    probed = [line for line in lines if "psnr" in line]
    assert [line["iteration"] for line in probed] == [5, 10, 12]
    method = build_method(config)
    folder_of(config).resume(method)
    last = probe(method.render, load_scene(config, torch.device("cpu")).test[0])
    assert last == {name: probed[-1][name] for name in ("psnr", "polar_transmittance")}


def test_a_loss_that_waits_for_a_gpu_is_not_logged(tmp_path):
    """Reading it would stop the GPU beside the clock of training; a tensor on meta raises instead."""
    log = RunStore(tmp_path)
    for iteration, loss in enumerate((torch.zeros((), device="meta"), 0.25), 1):
        log.log(Record(iteration, 0.5, loss, 0.125, 0.25, {"anchors": 7}), {"psnr": 21.5})
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    line = {"progress": 0.5, "seconds": 0.125, "anchors": 7, "psnr": 21.5}
    assert lines == [{"iteration": 1, **line}, {"iteration": 2, "loss": 0.25, **line}]


@pytest.mark.parametrize("how", ["file", "signal"])
def test_a_run_that_is_asked_to_stop_and_score_fades_and_ends_well(config, how):
    """The last two of twelve iterations are what it fades in."""

    class Asking(Callback):
        looks = 0

        def started(self, folder: Path) -> None:
            self.folder = folder

        def stop_requested(self) -> bool:  # looked at once an iteration
            self.looks += 1
            if self.looks == 4 and how == "file":
                (self.folder / "stop").touch()
            elif self.looks == 4:
                os.kill(os.getpid(), signal.SIGUSR1)
                os.kill(os.getpid(), signal.SIGUSR1)  # which changes nothing
            return False

    said = io.StringIO()
    result = pipeline.run(config, Console(file=said, width=200), Asking())
    assert result.status == "ok" and result.ended == "asked to stop and score"
    assert result.iterations_done == 6 and result.variant == "stopped after 6 iterations"
    assert result.scores["paper"].metrics["psnr"] is not None and "after 6 iterations: asked" in said.getvalue()
    assert not (folder_of(config).path / "stop").exists(), "it would stop the next start, too"


def test_a_finished_run_is_shown_and_not_repeated(config, monkeypatch):
    first, _ = run(config)
    (settings := folder_of(config).path / "config.yaml").rename(kept := settings.with_name("kept"))
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained again"))
    again, said = run(config)
    assert again == first
    assert "finished before" in said and f"{first.scores['paper'].metrics['psnr']:.2f}" in said
    assert settings.read_bytes() == kept.read_bytes(), "it was lost"


def test_a_run_without_test_views_is_finished_all_the_same(config, monkeypatch):
    """data.split=all"""
    monkeypatch.setattr(pipeline.data, "load", lambda path, format, options: replace(tiny_scene(), test=()))
    first, _ = run(config)
    assert first.ok and first.scores == {}
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained again"))
    again, said = run(config)
    assert again == first and "nothing to do" in said


def test_another_protocol_scores_the_finished_run_without_training(config, monkeypatch):
    first, _ = run(config)
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained again"))
    sphere = composed("protocol=sphere", "protocol.sphere.lpips=none").protocols
    both, _ = run(replace(config, protocols={**config.protocols, **sphere}))
    assert both.scores["paper"] == first.scores["paper"]
    assert both.scores["sphere"].metrics["psnr"] == first.scores["paper"].metrics["psnr"]
    assert both.scores["sphere"].metrics["ws_psnr"] is not None


def test_another_protocol_scores_a_run_whose_time_ran_out_too(config):
    first, _ = run(config)
    results.write(replace(first, status="timeout"), folder_of(config).path)
    sphere = composed("protocol=sphere", "protocol.sphere.lpips=none").protocols
    both, _ = run(replace(config, protocols={**config.protocols, **sphere}))
    assert both.status == "timeout" and both.scores.keys() == {"paper", "sphere"}


def test_scores_are_not_replaced_by_those_under_other_rules_of_the_same_name(config, monkeypatch):
    def under(*overrides):
        protocols = composed("protocol=paper", "protocol.paper.lpips=none", *overrides).protocols
        return replace(config, protocols=protocols)

    first, _ = run(under())
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained again"))
    with pytest.raises(RunFolderError, match=r"scores of paper .*\(bottom_crop=0.0, not 0.25\).* set run.folder"):
        run(under("protocol.paper.bottom_crop=0.25"))
    assert folder_of(config).result() == first
    monkeypatch.setattr(
        pipeline, "score", lambda *_, **__: {"paper": replace(first.scores["paper"], protocol=with_lpips)}
    )
    asked = under("protocol.paper.lpips=alex")
    with_lpips = first.scores["paper"].protocol | {"lpips": "alex"}
    assert run(asked)[0].scores["paper"].protocol == with_lpips, "more than before"
    assert run(under())[0].scores["paper"].protocol == with_lpips, "less keeps what there is"
    with pytest.raises(RunFolderError, match=r"\(lpips=alex, not vgg\)"):
        run(under("protocol.paper.lpips=vgg"))


def test_lpips_that_lacked_weights_is_added_once_there_are_some(config, monkeypatch):
    asked = replace(config, protocols=composed("protocol=paper").protocols)
    monkeypatch.setattr(lpips, "_load", lambda *_: "none")
    without, _ = run(asked)
    assert without.scores["paper"].metrics["lpips_vgg_01"] is None
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained again"))
    monkeypatch.setattr(pipeline, "scored", lambda *_: pytest.fail("scored again"))
    assert run(asked)[0] == without
    monkeypatch.setattr(pipeline, "has_weights", lambda net: net == "vgg")
    monkeypatch.setattr(evaluate, "lpips", lambda *_, **__: torch.tensor(0.25))
    checkpoint = folder_of(asked).checkpoint
    checkpoint.rename(checkpoint.with_name("moved"))
    assert run(asked)[0] == without, "nothing is left to score"
    checkpoint.with_name("moved").rename(checkpoint)
    assert run(asked)[0].scores["paper"].metrics["lpips_vgg_01"] == 0.25
    assert run(asked)[1].count("nothing to do") == 1


def test_without_its_checkpoint_a_finished_run_is_not_scored_anew(config):
    first, _ = run(config)
    folder = folder_of(config)
    log = (folder.path / "log.jsonl").read_bytes()
    shutil.rmtree(folder.checkpoint)
    sphere = composed("protocol=sphere", "protocol.sphere.lpips=none").protocols
    with pytest.raises(RunFolderError, match="no checkpoint any more, .* other rules of sphere"):
        run(replace(config, protocols={**config.protocols, **sphere}))
    assert folder.result() == first and (folder.path / "log.jsonl").read_bytes() == log


def test_too_few_views_for_early_stopping_are_refused_before_training(config, monkeypatch):
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained"))
    with pytest.raises(ValueError, match="5 training views leave no validation views.*it takes 6"):
        run(replace(config, budget=replace(config.budget, stop="auto")))
    assert not Path(config.run.folder).exists() or not [*Path(config.run.folder).glob("*/result.json")]


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (Failure("nan", "loss is nan at iteration 3"), "nan"),
        (MemoryError("no more"), "oom"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9000000000 bytes"), "oom"),
        (ValueError("the point cloud is empty"), "rejected"),
    ],
)
def test_a_failed_run_has_a_result_with_its_status(config, monkeypatch, error, status):
    def fail(*_):
        raise error

    monkeypatch.setattr(PaDGSMethod, "fit", fail)
    result, said = run(config)
    assert (result.status, result.scores) == (status, {}) and result.reason in said and status in said
    reasons = {RuntimeError: "9.0 GB more were requested than there are"}
    assert reasons.get(type(error), str(error)) in result.reason and "Allocator" not in result.reason
    again, said = run(config)
    assert again == result and "retry=failed" in said


def test_a_failed_run_that_starts_again_stays_in_the_experiments_that_want_it(config, monkeypatch):
    def fail(*_):
        raise Failure("oom", "no memory")

    with monkeypatch.context() as patch:
        patch.setattr(PaDGSMethod, "fit", fail)
        assert run(replace(config, labels=Labels("padgs", ("table1",))))[0].experiments == ("table1",)
    again, _ = run(replace(config, labels=Labels("padgs", ("table4",)), retry="failed"))
    assert (again.status, again.experiments) == ("ok", ("table1", "table4"))
    assert results.read(folder_of(config).path / "result.json") == again


def test_the_model_of_an_earlier_run_is_freed_before_the_next(config):
    """Its densifier refers to it."""
    method = build_method(composed("method=omnigs", "render.backend=torch"))
    next(method.fit(tiny_scene(), Budget(2)))
    model = weakref.ref(method.model)
    gc.disable()
    try:
        del method
        assert model() is not None
        pipeline.start(config)
        assert model() is None
    finally:
        gc.enable()


def test_one_frame_lies_between_a_job_and_its_method(config, monkeypatch):
    frames = []

    def fit(self, scene, budget):
        frames.extend(frame.function for frame in inspect.stack() if Path(frame.filename).is_relative_to(PACKAGE))
        raise Failure("nan", "for the test")

    monkeypatch.setattr(PaDGSMethod, "fit", fit)
    run(config)
    assert frames == ["run"]


def test_a_run_that_another_process_works_on_is_left_alone(config):
    first, _ = run(config)
    folder = folder_of(config)
    (folder.path / "result.json").unlink()
    with folder, pytest.raises(RunBusy, match=f"worked on by process {os.getpid()} on .* since"):
        run(config)
    assert run(config)[0].scores == first.scores


def test_a_finished_run_learns_which_other_experiments_want_it(config, monkeypatch):
    first, _ = run(replace(config, labels=Labels("padgs", ("table1",))))
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained again"))
    again, _ = run(replace(config, labels=Labels("padgs", ("table4",))))
    assert again.experiments == ("table1", "table4") and first.experiments == ("table1",)
    assert replace(again, experiments=first.experiments) == first
    assert results.read(folder_of(config).path / "result.json") == again


def test_a_run_of_a_sweep_that_is_asked_for_by_itself_stands_in_tables(config):
    run(replace(config, labels=Labels("padgs", ("tau",))))
    for seed in range(2):
        run(replace(config, labels=Labels("padgs"), seed=seed))
    found, _ = store.read(Path(config.run.folder))
    rows = RunSet(frame(found)).chosen("methods")
    assert sorted(rows["seed"]) == [0, 1] and set(rows["experiments"]) == {("ad_hoc",), ("ad_hoc", "tau")}


def test_an_error_of_ours_is_no_result(config, monkeypatch):
    def fail(*_):
        raise RuntimeError("a bug")

    monkeypatch.setattr(PaDGSMethod, "fit", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        run(config)
    assert not (folder_of(config).path / "result.json").exists()


def test_time_running_out_is_a_status_and_the_model_is_scored(config):
    config = replace(config, train=replace(config.train, max_seconds=1e-9), retry="failed")
    result, _ = run(config)
    assert result.status == "timeout" and result.iterations_done < ITERATIONS
    assert result.scores["paper"].metrics["psnr"] is not None
    again, said = run(config)
    assert again == result and "finished before, nothing to do\n" in said, "it would have no more time than before"


def test_a_run_of_seconds_that_fails_before_its_first_iteration_has_none(config, monkeypatch):
    def fail(*_):
        raise Failure("oom", "no memory")

    monkeypatch.setattr(PaDGSMethod, "fit", fail)
    result, _ = run(replace(config, budget=replace(config.budget, seconds=9.0)))
    assert (result.status, result.iterations, result.iterations_done) == ("oom", 0, 0)


def test_files_whose_names_no_result_may_have_are_refused_early():
    for choices in ({"method": "mine/x"}, {"experiment": "mine/tau", "method": "padgs"}, {"sweep": "_tau"}):
        with pytest.raises(ConfigError, match="cannot be the name of results; .* in no subfolder"):
            labels(choices)


def test_a_run_folder_that_cannot_be_made_is_a_clear_error(config, tmp_path):
    (tmp_path / "file").write_text("")
    blocked = replace(config, run=replace(config.run, folder=str(tmp_path / "file")))
    with pytest.raises(RunFolderError, match="cannot write run folder .*name another place .run.folder"):
        run(blocked)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full to stand in for a full disk")
def test_a_full_disk_while_logging_is_a_clear_error(config, monkeypatch):
    stop_at(1, monkeypatch, lambda: (folder_of(config).path / "log.jsonl").symlink_to("/dev/full"))
    with pytest.raises(RunFolderError, match="No space left on device; make room"):
        run(config)


def test_versions_of_a_run_that_was_resumed_often_stay_a_name(config):
    result, before = run(config)[0], Progress(0, 0.0, 0.0, 0.0)
    for commit in range(40):
        newest, made_by = _joined(replace(result, code_version=f"{commit:010d}"), before)
        before = replace(before, made_by=made_by)
    assert newest.code_version.startswith("0000000000 then others then ") and newest.code_version.endswith("0000000039")
    assert results.decoded(results.encoded(newest), "") == newest


def test_a_terminal_without_unicode_changes_no_result(config):
    raw = io.BytesIO()
    console = Console(file=io.TextIOWrapper(raw, "latin-1", errors="backslashreplace"), width=200)
    assert pipeline.run(config, console).ok and raw.getvalue()


def test_a_text_that_cannot_be_shown_is_no_status_of_a_run(config):
    with pytest.raises(UnicodeError):
        pipeline.run(config, Console(file=io.TextIOWrapper(io.BytesIO(), "latin-1"), width=200))
    assert not [*Path(config.run.folder).glob("*/result.json")]
