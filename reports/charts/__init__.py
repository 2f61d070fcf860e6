"""Charts of results, with matplotlib."""
