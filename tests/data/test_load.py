import pytest

from padgs.data import DataError, load


def test_a_data_set_without_a_folder_is_not_the_built_in_room():
    with pytest.raises(DataError, match=r"data.path is not set; .* \+scene=roam360_bar"):
        load(dataset="roam360")
