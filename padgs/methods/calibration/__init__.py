"""Cameras that learn along: poses, a panoramic camera that is not ideal, two lenses."""
