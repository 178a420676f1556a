"""Data sets: a recipe, the captures that follow from it, and what they are like."""
