"""Scores of a range image: errors, regions, depth statistics, error against coverage."""
