"""From panoramas without poses, or a video, to a data set: structure from motion."""
