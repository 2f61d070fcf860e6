"""Runs mirrored into mlflow."""
