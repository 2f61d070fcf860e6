from pathlib import Path

import pytest

from padgs.files import atomic_path


def test_a_file_takes_its_place_when_it_is_complete_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "room.compressed.ply"
    path.write_text("the earlier one")
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as draft:
        draft.write_text("half of")
        raise KeyboardInterrupt
    assert path.read_text() == "the earlier one"
    with atomic_path(path) as draft:
        assert draft.name.endswith(".compressed.ply") and draft.name.startswith(".")
        draft.write_text("the new one")
        assert path.read_text() == "the earlier one"
    assert path.read_text() == "the new one" and list(tmp_path.iterdir()) == [path]
