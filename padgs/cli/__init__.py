"""`padgs`: commands and their options."""
