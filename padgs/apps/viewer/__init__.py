"""Interactive viewer of runs in the browser, rendered by padgs."""
