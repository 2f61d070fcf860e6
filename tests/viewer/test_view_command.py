"""What `padgs view` refuses before it serves anything, and where it opens the page by itself."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from tiny_run import tiny_run
from typer.testing import CliRunner

from padgs.cli.commands import app
from padgs.viewer import process
from padgs.viewer.server import EVERYWHERE, LOCAL


def test_runs_of_two_scenes_are_not_shown_beside_each_other(tmp_path_factory):
    runs = [str(tiny_run(tmp_path_factory, f"data.generator.scene={scene}")) for scene in ("room", "white_room")]
    said = CliRunner().invoke(app, ["view", runs[0], "--beside", runs[1]])
    assert said.exit_code == 1 and "are of two scenes" in " ".join(said.output.split())
    said = CliRunner().invoke(app, ["view", runs[0], "--data", "gone"])
    assert said.exit_code == 1 and f"it is the data of {runs[0]}" in " ".join(said.output.split())


@pytest.mark.parametrize(("host", "browse", "opens"), [(LOCAL, True, 1), (LOCAL, False, 0), (EVERYWHERE, True, 0)])
def test_a_page_of_this_machine_alone_is_opened_where_there_is_a_screen(monkeypatch, host, browse, opens):
    opened = []
    monkeypatch.setattr(process.webbrowser, "open", opened.append)
    monkeypatch.setattr(process.signal, "signal", lambda *_: None)
    monkeypatch.setattr(process, "serving", lambda runs, **_: nullcontext(SimpleNamespace(address="http://here")))
    monkeypatch.setattr(process, "_is_wanted", lambda: False)
    process.serve([], host=host, browse=browse)
    assert opened == opens * ["http://here"]


def test_a_screen_is_one_with_windows_on_this_machine(monkeypatch):
    monkeypatch.setattr(process.sys, "stdout", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(process.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION"):
        monkeypatch.delenv(name, raising=False)
    assert not process.has_screen()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert process.has_screen()
    monkeypatch.setenv("SSH_CONNECTION", "from afar")
    assert not process.has_screen()
