"""`padgs bench`: the time of each part of training and rendering, beside the least time at the machine's ceilings."""
