import pytest
from typer.testing import CliRunner

from padgs.baselines import METHODS
from padgs.checks import lookup
from padgs.cli.commands import app
from padgs.multirun.manual import keys, manual
from padgs.runs.config import Settings


def test_help_lists_every_key_with_its_default_and_meaning(root, monkeypatch):
    monkeypatch.setenv("PADGS_ROOT", str(root))
    lines = manual(["--help", "method=padgs"], 100).splitlines()
    shown = {line.split("=")[0].strip(): line for line in lines if line.startswith("  ") and "=" in line}
    assert "train.iterations=1500" in shown["train.iterations"] and "omnigs_release" in "".join(lines)
    assert "method.tau=0.9" in shown["method.tau"] and "Eq. 15; 0 turns opacity modulation off" in shown["method.tau"]
    assert "pixels; the height is half of it" in shown["data.generator.width"] and max(map(len, lines)) <= 100
    assert "published: for 30 000" in shown["train.learning_rates"], "the comment above it"
    assert "render.projection=ray" in manual(["--help"]), "padgs+ renders by rays"
    assert all(text in "\n".join(lines) for text in ("budget=auto, given", "train=default, released", "+ablation=a0_"))
    assert all(name in shown["+scene"] for name in ("noisy_poses", "omniblender_LOU")), "of files and of data sets"


@pytest.mark.parametrize("name", METHODS)
def test_every_key_has_a_meaning(name):
    groups = (Settings, lookup(METHODS, name, "method").Options)
    shown = {key: meaning for kind in groups for key, _, meaning in keys(kind())}
    assert [key for key, meaning in shown.items() if not meaning] == []


@pytest.mark.slow
def test_padgs_completes():
    asked = {"_PADGS_COMPLETE": "complete_bash", "COMP_WORDS": "padgs con", "COMP_CWORD": "1"}
    assert "convert" in CliRunner().invoke(app, [], env=asked, prog_name="padgs").output
