"""`padgs bench`: how long each part of training and rendering takes, and how far it is from what the machine can do.

`padgs.apps.bench.report.measure_all` returns everything as one dict, whose layout it documents.
"""
