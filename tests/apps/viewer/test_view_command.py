"""`padgs view`: refusals, and opening the browser."""

import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from support.tiny_run import tiny_run
from typer.testing import CliRunner

from padgs.apps.viewer import pages
from padgs.apps.viewer import server as process
from padgs.cli.commands import app

pytest.importorskip("viser", reason="the extra `view` is not installed")


def test_runs_of_different_scenes_are_refused(tmp_path_factory):
    runs = [str(tiny_run(tmp_path_factory, f"data.generator.scene={scene}")) for scene in ("room", "white_room")]
    result = CliRunner().invoke(app, ["view", runs[0], "--beside", runs[1]])
    assert result.exit_code == 1 and "are of two scenes" in " ".join(result.output.split())
    result = CliRunner().invoke(app, ["view", runs[0], "--data", "gone"])
    assert result.exit_code == 1 and f"it is the data of {runs[0]}" in " ".join(result.output.split())


@pytest.mark.parametrize(("local", "browse", "opens"), [(True, True, 1), (True, False, 0), (False, True, 0)])
def test_local_pages_are_opened_in_a_browser(monkeypatch, local, browse, opens):
    visited, shown = [], []
    server = SimpleNamespace(address="http://here", is_local=local, viser=MagicMock())
    monkeypatch.setattr(process.webbrowser, "open", visited.append)
    monkeypatch.setattr(process, "start_server", lambda **_: nullcontext(server))
    monkeypatch.setattr(process.time, "sleep", MagicMock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr(pages, "show_runs", lambda _, runs: nullcontext(shown.extend(runs)))
    with pytest.raises(KeyboardInterrupt):
        process.serve(lambda: [*visited, "a run"], browse=browse)
    assert shown == [*opens * ["http://here"], "a run"], "browsers load the page while the run is being opened"


@pytest.mark.parametrize(("ends", "code", "is_named"), [(KeyboardInterrupt, 130, True), (OSError("no host"), 1, False)])
def test_the_next_command_is_named_at_its_end_and_after_no_error(tmp_path, monkeypatch, ends, code, is_named):
    (tmp_path / "config.yaml").touch()
    monkeypatch.setattr(process, "serve", MagicMock(side_effect=ends))
    done = CliRunner().invoke(app, ["view", str(tmp_path)])
    assert (done.exit_code, f"next: padgs render {tmp_path}" in done.stdout) == (code, is_named), done.output


def test_no_run_is_opened_before_all_have_a_checkpoint(tmp_path, monkeypatch):
    """Wait for all runs first: one opened before would be old by then."""
    done = []
    scene = SimpleNamespace(name="room")
    opened = lambda path, *_, **__: done.append(("open", path)) or SimpleNamespace(notes=(), scene=scene)  # noqa: E731
    monkeypatch.setattr(process, "wait_for_checkpoint", lambda folder: done.append(("wait", folder)))
    monkeypatch.setattr("padgs.apps.external.open_model", opened)
    monkeypatch.setattr(process, "serve", lambda load_runs, **_: load_runs())
    folders = [str(tmp_path / name) for name in ("one", "other")]
    for folder in folders:
        Path(folder).mkdir()
        (Path(folder) / "config.yaml").touch()
    assert CliRunner().invoke(app, ["view", folders[0], "--beside", folders[1]]).exit_code == 0
    assert done == [(step, folder) for step in ("wait", "open") for folder in folders]


def test_files_are_opened_before_the_page_is_served_and_once(tmp_path, monkeypatch):
    """An error needs no page, and stands alone."""
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    shown = MagicMock()
    monkeypatch.setattr(process, "serve", shown)
    done = CliRunner().invoke(app, ["view", str(tmp_path / "a.ply")])
    assert done.exit_code == 1 and "a.ply is not a readable PLY file" in done.output and not shown.called
    found = MagicMock(return_value=SimpleNamespace(notes=(), scene=SimpleNamespace(name="room")))
    monkeypatch.setattr("padgs.apps.external.open_model", found)
    assert CliRunner().invoke(app, ["view", str(tmp_path / "a.ply"), "--device", "cpu"]).exit_code == 0
    assert shown.call_args.args[0]() == [found.return_value]
    assert found.call_count == 1 and found.call_args.kwargs == {"device": "cpu"}


def test_the_page_is_served_before_torch_is_loaded():
    code = "import sys, viser, padgs.cli.view, padgs.apps.viewer.server; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_screen_is_graphical_and_local(monkeypatch):
    monkeypatch.setattr(process.sys, "stdout", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(process.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION"):
        monkeypatch.delenv(name, raising=False)
    assert not process.has_screen()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert process.has_screen()
    monkeypatch.setenv("SSH_CONNECTION", "from afar")
    assert not process.has_screen()
