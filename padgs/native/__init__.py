"""The compiled code and how it is called: drawing, decoding, the loss, and the ceilings of a machine."""

from padgs.native import cpu, cuda

LIBRARIES = {"cpu": cpu, "cuda": cuda}  # by the type of the devices whose tensors they take
