"""One file for each format of a data set, and what they share: `read(path, options) -> Capture`, `load -> Scene`."""
