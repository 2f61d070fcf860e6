import subprocess
import sys

import pytest

from padgs.baselines import METHODS
from padgs.checks import lookup
from padgs.data import LOADERS
from padgs.render import BACKENDS, leave_one_out
from padgs.render.projection import PROJECTIONS

REGISTRIES = {
    "backend": BACKENDS,
    "leave-one-out backend": leave_one_out.BACKENDS,
    "projection": PROJECTIONS,
    "loader": LOADERS,
    "method": METHODS,
}
ENTRIES = [(kind, name) for kind, registry in REGISTRIES.items() for name in registry]


@pytest.mark.parametrize(("kind", "name"), ENTRIES, ids=lambda value: value)
def test_every_entry_of_every_registry_can_be_had(kind, name):
    assert callable(lookup(REGISTRIES[kind], name, kind))


@pytest.mark.parametrize("kind", REGISTRIES)
def test_an_unknown_name_lists_the_known_ones(kind):
    registry = REGISTRIES[kind]
    with pytest.raises(ValueError, match=f"unknown {kind} 'cud'; known: ") as caught:
        lookup(registry, "cud", kind)
    assert str(caught.value).endswith(", ".join(sorted(registry)))


def test_nothing_is_imported_before_it_is_asked_for(root):
    code = (
        "import sys\n"
        "from padgs.checks import lookup\n"
        "registry = {'wanted': 'colorsys:rgb_to_hsv', 'broken': 'no_such_module:thing'}\n"
        "assert 'colorsys' not in sys.modules and 'torch' not in sys.modules\n"
        "assert lookup(registry, 'wanted', 'thing')(1, 1, 1) == (0.0, 0.0, 1)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root)


@pytest.mark.parametrize("missing", ["no_such_module", "no_such_thing"])
def test_a_broken_entry_of_another_package_names_itself_and_what_is_missing(missing):
    place = "no_such_module:thing" if missing == "no_such_module" else "math:no_such_thing"
    with pytest.raises(ValueError, match=f"thing broken cannot be used: {place} of another package fails .*{missing}"):
        lookup({"broken": place}, "broken", "thing")
