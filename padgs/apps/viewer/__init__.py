"""A run to walk through in the browser, drawn by our own renderer."""
