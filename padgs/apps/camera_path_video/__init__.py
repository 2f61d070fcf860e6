"""Films: paths of a camera, and the files that their frames go into."""
