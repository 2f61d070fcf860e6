"""`padgs`: one file a command."""
