"""The compiled libraries, their sources (csrc/), and how they are found and loaded. Importing this loads nothing."""
