"""Training: what a method is, the loop around an iteration, losses, schedules, and the ways in which it fails."""
