"""Curves and points, and how they are drawn."""
