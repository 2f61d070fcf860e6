"""Structure from motion: from panoramas without poses, or a 360-degree video, to a data set."""
