"""How many Gaussians a scene needs: the smallest model that is as good as a trained one, and all sizes between."""

STATED = 0.1  # dB that the kept model may lose, unless another loss is asked for
