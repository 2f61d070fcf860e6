"""What the paper claims, judged by what was measured here: claims as data, rules that judge them, a page."""
