"""Runs in training: followed from checkpoint to checkpoint."""

import json
import shutil
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from support.chromium import in_chromium, visiting
from support.tiny_run import tiny_run

import padgs
from padgs import results
from padgs.apps.viewer import pages
from padgs.apps.viewer.pages import show_runs
from padgs.apps.viewer.renders import RunRenderer, ViewOptions
from padgs.apps.viewer.server import LOCAL, start_server, wait_for_checkpoint
from padgs.runs import checkpoint
from padgs.runs.store import RunStore
from padgs.training.model import State

try:
    import viser
except ImportError:
    viser = None
WITH_VISER = pytest.mark.skipif(viser is None, reason="the extra `view` is not installed")


@pytest.fixture
def folder(tmp_path_factory, tmp_path) -> Path:
    """Return the folder of an unfinished run."""
    training = tmp_path / "training"
    shutil.copytree(tiny_run(tmp_path_factory), training)
    (training / results.FILE_NAME).unlink()
    return training


def train_on(folder: Path) -> None:
    """Write a modified checkpoint, ten iterations later."""
    place = folder / "checkpoint"
    before, run = checkpoint.load(place), json.loads((place / checkpoint.MANIFEST).read_text())["run"]
    tensors = {name: 0.9 * tensor if name.endswith("means") else tensor for name, tensor in before.tensors.items()}
    progress = before.values["progress"]
    progress = {**progress, "iteration": progress["iteration"] + 10}
    checkpoint.save(State(tensors, {**before.values, "progress": progress}), place, run)


def test_training_is_followed(folder):
    renderer = RunRenderer(padgs.load_run(folder, device="cpu"))
    scene, pose = renderer.run.scene, renderer.run.scene.train[0].cam_from_world

    def image() -> np.ndarray:
        return renderer.render(ViewOptions("panorama"), pose, 32, 16)

    first = image()
    assert "after 30 iterations" in renderer.summary and not renderer.update()
    train_on(folder)
    assert renderer.update() and "after 40 iterations" in renderer.summary
    assert not np.array_equal(image(), first)
    assert renderer.run.scene is scene, "the scene is not loaded again"
    (folder / "checkpoint" / checkpoint.MANIFEST).write_text("{")
    assert renderer.update() and "cannot follow" in renderer.summary and not renderer.update()
    assert "after 40 iterations" in renderer.summary and image().std() > 0, "what cannot be read changes no picture"


def test_a_finished_run_is_not_followed(tmp_path_factory):
    renderer = RunRenderer(padgs.load_run(tiny_run(tmp_path_factory), device="cpu"))
    assert not renderer.update() and "iterations" not in renderer.summary
    renderer.stop()
    assert not renderer.run.files.stop.exists(), "nor ended: the next run of that name would end at once"


def test_only_a_run_in_training_is_asked_to_stop(folder):
    renderer = RunRenderer(padgs.load_run(folder, device="cpu"))
    renderer.stop()
    assert not renderer.run.files.stop.exists(), "the next start would end at once"
    with RunStore(folder):
        renderer.stop()
    assert renderer.run.files.stop.exists()


def test_the_end_of_training_is_detected(folder, tmp_path_factory):
    renderer = RunRenderer(padgs.load_run(folder, device="cpu"))
    shutil.copy(tiny_run(tmp_path_factory) / results.FILE_NAME, folder)
    renderer.stop()
    assert not renderer.run.files.stop.exists(), "it has ended, although the page does not say so yet"
    assert renderer.update() and "iterations" not in renderer.summary and not renderer.update()


@WITH_VISER
@pytest.mark.slow
@in_chromium
@pytest.mark.parametrize("host", [LOCAL, "0.0.0.0"])
def test_only_local_pages_can_stop_training(folder, host):
    run = padgs.load_run(folder, device="cpu")
    with start_server(host=host, port=8460) as server, show_runs(server, [run]), visiting(server.address) as visit:
        visit.wait("document.body.innerText.includes('pixels across')")
        if host != LOCAL:
            visit.page.wait_for_timeout(500)
            assert "stop and score" not in visit.page.inner_text("body")
            return
        for answer in ("continue training", "stop training"):
            assert not (folder / "stop").exists()
            visit.page.get_by_role("button", name="stop and score").click()
            visit.page.get_by_role("button", name=answer).click()
            visit.wait("!document.body.innerText.includes('Stop training now?')")
        end = time.monotonic() + 20
        while not (folder / "stop").exists():
            assert time.monotonic() < end, "no stop was requested"
            time.sleep(0.05)


@dataclass
class Renewed:
    """Page that records redraws."""

    redrawn: threading.Event = field(default_factory=threading.Event)

    def redraw(self) -> None:
        self.redrawn.set()

    def close(self) -> None:
        """Do nothing."""


@WITH_VISER
def test_pages_redraw_after_a_checkpoint(folder, monkeypatch):
    monkeypatch.setattr(pages, "UPDATE_SECONDS", 0.05)
    page = Renewed()
    with start_server(port=8440) as server, show_runs(server, [padgs.load_run(folder, device="cpu")]) as there:
        there[-1] = page
        assert not page.redrawn.wait(0.3)
        train_on(folder)
        assert page.redrawn.wait(30)


def test_wait_for_the_first_checkpoint(folder, tmp_path, capsys):
    wait_for_checkpoint(folder)
    wait_for_checkpoint(tmp_path / "nothing")
    assert not capsys.readouterr().out
    moved = (folder / "checkpoint").rename(tmp_path / "elsewhere")
    with RunStore(folder):  # as training does
        waiting = threading.Thread(target=wait_for_checkpoint, args=(folder,), daemon=True)
        waiting.start()
        waiting.join(0.2)
        assert waiting.is_alive()
        moved.rename(folder / "checkpoint")
        waiting.join(30)
        assert not waiting.is_alive()
    assert capsys.readouterr().out.count("waiting for the first checkpoint") == 1


def test_a_killed_run_without_checkpoint_is_refused(folder):
    shutil.rmtree(folder / "checkpoint")
    with pytest.raises(ValueError, match="no process trains it; start the same padgs-run again"):
        wait_for_checkpoint(folder)
    (folder / results.FILE_NAME).write_text("{}")
    wait_for_checkpoint(folder)  # it failed, and will have none
