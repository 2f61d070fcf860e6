import os
import subprocess
import sys
import warnings

import pytest
from typer.testing import CliRunner

from padgs.cli.commands import app
from padgs.cli.errors import MAX_THREADS, name_place, without_traceback
from padgs.data.capture import DataError
from padgs.files import ImageError

TOO_LARGE = str(10**40)
NUMBERS = {
    "bench --threads": f"0 to {MAX_THREADS}",
    "bench --repeats": "0 to 10000",
    "bench --seed": "0 to 4294967295",
    "convert SOURCE OUT --to colmap --width": "0 to 65536",
    "export RUN --distillation-steps": "0 to 100000",
    "prepare SOURCE OUT --seed": "0 to 4294967295",
    "prepare SOURCE OUT --threads": f"0 to {MAX_THREADS}",
    "view RUN --port": "1 to 65535",
}
NOT_WHOLE = ("nan", "inf", "1e30", "x")


def run(*arguments: str):
    return CliRunner().invoke(app, arguments)


@pytest.mark.parametrize("option", NUMBERS)
def test_whole_numbers_out_of_range_are_refused(option, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = option.rpartition(" ")[2]
    for value in ("-1", TOO_LARGE):
        done = run(*option.split(), value)
        assert done.exit_code == 1 and f"error: {name} is {value}; it must be from {NUMBERS[option]}" in done.output
    for value in NOT_WHOLE:
        assert run(*option.split(), value).exit_code == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("line", "name"),
    [
        *((f"{name} @", "run") for name in ("export", "render", "smallest", "view")),
        *((f"{name} run --data @", "data") for name in ("export", "render", "smallest", "view")),
        ("render run --path @", "path"),
        ("merge @ run", "runs"),
        ("split @ --blocks 2", "source"),
        ("convert @ there --to colmap", "source"),
        ("convert here @ --to colmap", "destination"),
        ("prepare @ there", "source"),
        ("check @", "path"),
        ("check here --format @", "format"),
        ("track @", "runs"),
        ("report all @", "runs"),
        ("score file.ply --data @", "data"),
        ("score file.ply --data here --to @", "to"),
    ],
)
def test_empty_texts_are_refused(line, name, tmp_path, monkeypatch):
    """A variable of the shell that is not set gives one."""
    monkeypatch.chdir(tmp_path)
    done = run(*(word.replace("@", "") for word in line.split()))
    assert done.exit_code == 1 and f"error: {name} is empty (is a variable of the shell unset?)" in done.output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "rule"),
    [
        ("prepare SOURCE OUT --per-second", "it must be from 0.001 to 1000"),
        ("smallest RUN --epsilon", "it must be one of 0.05, 0.1"),
    ],
)
def test_numbers_out_of_range_are_refused(option, rule):
    for value in ("nan", "inf", "-1", "0", "1e30"):
        done = run(*option.split(), value)
        assert done.exit_code == 1 and rule in " ".join(done.output.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("report", "all", "/dev/zero"), "there is no folder /dev/zero; give"),
        (("track", "."), "no finished run is in .; give the folder of the runs"),
        (("check", ".", "--overlay", "x.txt"), "--overlay x.txt is no .png or .jpg; choose another name"),
        (("export", "no\x1b[2J\u202edir"), r"no\x1b[2J\u202edir has no config.yaml; give the folder of one run"),
        (("bench", "--quick", "--out", "file"), "cannot write file/bench.json: file is not a folder; name another"),
        (("bench", "--quick", "--out", "taken"), "cannot write taken/bench.json: Is a directory; name another place"),
        (("bench", "--device", "gpu"), "unknown device 'gpu'; known: cpu, cuda"),
    ],
)
def test_wrong_places_and_names_are_refused(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "bench.json").mkdir(parents=True)
    done = run(*arguments)
    assert done.exit_code == 1 and message in " ".join(done.output.split())


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (PermissionError(13, "Permission denied", "there"), "error: there: Permission denied"),
        (MemoryError(), "error: out of memory"),
        (RuntimeError("CUDA error"), "error: CUDA error"),
    ],
)
def test_errors_are_one_line(error, message, capsys):
    @without_traceback
    def command() -> None:
        raise error

    with pytest.raises(RuntimeError):  # `typer.Exit`
        command()
    assert capsys.readouterr().err == f"{message}\n"


def test_a_damaged_file_of_gaussians_is_not_taken_for_the_data_of_a_run(capsys, tmp_path):
    @without_traceback
    def command(run: str, beside: str = "") -> None:
        raise DataError("a.ply is no PLY file; export it again")

    place = "if it has moved, name its place with --data"
    for run, beside, more in (
        ("a.ply", "", ""),
        ("./a.ply", "", ""),
        ("runs/a", "a.ply", ""),
        ("runs/a", "", f"; it is the data of runs/a: {place}"),
        ("runs/a", "runs/b", f"; it is the data of runs/a or runs/b: {place}"),
    ):
        with pytest.raises(RuntimeError):  # `typer.Exit`
            command(run=run, beside=beside)
        assert capsys.readouterr().err == f"error: a.ply is no PLY file; export it again{more}\n"
    (tmp_path / "b.ply").touch()
    with pytest.raises(RuntimeError):
        command(run=str(tmp_path / "b.ply"), beside="")
    assert place not in capsys.readouterr().err, "a file has no data"


def test_warnings_are_one_line():
    without_traceback(lambda: None)()
    assert (
        warnings.formatwarning("other \x1b data", UserWarning, "file.py", 1, "code()") == "warning: other \\x1b data\n"
    )


def test_a_damaged_image_is_not_blamed_on_the_place(tmp_path):
    with pytest.raises(ImageError, match="a.png is damaged"), name_place(tmp_path):
        raise ImageError("a.png is damaged")


def test_output_that_nobody_reads_ends_the_command_in_silence(root):
    reading, writing = os.pipe()
    os.close(reading)
    code = "from padgs.cli.app import main; import sys; sys.argv[1:] = ['bench', '--help']; main()"
    done = subprocess.run([sys.executable, "-c", code], stdout=writing, stderr=subprocess.PIPE, cwd=root)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, b"")


def test_a_command_without_any_output_succeeds(root):
    code = "import sys; sys.argv[1:] = ['convert', '--help']; from padgs.cli.app import main; main()"
    done = subprocess.run(["sh", "-c", 'exec "$0" -c "$1" >&-', sys.executable, code], stderr=subprocess.PIPE, cwd=root)
    assert (done.returncode, done.stderr) == (0, b"")


def test_help_breaks_lines_where_the_terminal_ends(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert "explicit ones; the loss is measured, printed and written into the file." in run("export", "--help").output
