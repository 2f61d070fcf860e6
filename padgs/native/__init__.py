"""Compiled code and its calls: rendering, decoding, loss, and the peak rates of a machine."""

from padgs.native import cpu, cuda

LIBRARIES = {"cpu": cpu, "cuda": cuda}  # by torch device type
