"""How many Gaussians a scene needs: the smallest model that is as good as a trained one, and all sizes between."""
