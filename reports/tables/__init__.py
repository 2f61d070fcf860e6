"""Tables as data: which results stand in which cell."""
