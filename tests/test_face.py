"""What `import padgs` offers: lazily, all of it, and nothing else."""

import subprocess
import sys

import pytest
from typer.testing import CliRunner

import padgs
from padgs.cli.commands import app


def test_everything_offered_is_there():
    assert all(callable(getattr(padgs, name)) for name in padgs.__all__)
    assert set(padgs.__all__) <= set(dir(padgs))
    assert set(padgs.__all__) == padgs._HOMES.keys()


def test_importing_it_imports_nothing_heavy():
    code = "import sys, padgs; assert not {'torch', 'numpy', 'hydra'} & set(sys.modules), 'heavy'"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_wrong_name_lists_the_right_ones():
    with pytest.raises(AttributeError, match="padgs has no 'load_scenes'; it offers load_scene, make_method"):
        _ = padgs.load_scenes


def test_the_version_is_said():
    result = CliRunner().invoke(app, ["--version"])
    assert result.exit_code == 0 and result.output.strip() == f"padgs {padgs.__version__}"


def test_a_method_is_made_by_its_name_and_settings(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))
    method = padgs.make_method("spags_sorted", "method.sh_degree=1", "seed=3")
    assert method.options.sh_degree == 1 and method.seed == 3
    assert (method.render_config.blending, method.render_config.projection) == ("sorted", "ray")
