"""Calibration: one stage per file, fitted from captures, applied as a chain."""
