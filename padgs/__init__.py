"""PaD-GS: panoramic Gaussian splatting with a distortion map, and the means to compare it fairly.

Nothing is imported here: `padgs.results` must load without torch, and `padgs --help` must answer at once.
"""
