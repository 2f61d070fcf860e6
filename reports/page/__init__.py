"""The page with everything in one file."""
