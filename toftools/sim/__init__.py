"""Simulation: scenes to captures."""
