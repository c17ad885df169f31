"""Crops of an image, and objects in it (pure)."""
