"""What goes wrong with captures and settings, as data: a condition changes any scene, or its training, by a level."""
