"""Calibration tables that makers of cameras ship, read as chains of this library.

Each loader is ``load(path, *, convention ...) -> Chain``. What a table leaves open (its sign, above
all) is a parameter with a stated default, and what is read but not applied stands in the notes: no
maker publishes how a table is meant, so a table is only as good as a flat wall behind it.
"""
