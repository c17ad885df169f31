"""Scores of a scene against ground truth."""
