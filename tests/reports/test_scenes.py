from padgs.reports.published import Place


def test_no_two_places_share_a_title_or_a_name_of_files():
    datasets, scenes = ("", "synthetic", "omniblender", "roam360"), ("room", "synthetic-room")
    places = [Place(dataset, scene, apart) for dataset in datasets for scene in scenes for apart in ("", "data 0123")]
    assert len({place.title for place in places}) == len({place.stem for place in places}) == len(places)
    assert [Place("", "room").stem, Place("synthetic", "synthetic-room").stem] == ["room", "synthetic-room"]
