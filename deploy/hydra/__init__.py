"""Hydra as the lower half of the pipeline: its scene graph in, names of its rooms out."""
