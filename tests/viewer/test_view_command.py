"""What `padgs view` refuses before it serves anything."""

from tiny_run import tiny_run
from typer.testing import CliRunner

from padgs.cli.commands import app


def test_runs_of_two_scenes_are_not_shown_beside_each_other(tmp_path_factory):
    runs = [str(tiny_run(tmp_path_factory, f"data.generator.scene={scene}")) for scene in ("room", "white_room")]
    said = CliRunner().invoke(app, ["view", runs[0], "--beside", runs[1]])
    assert said.exit_code == 1 and "are of two scenes" in " ".join(said.output.split())
