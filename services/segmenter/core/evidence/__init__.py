"""Descriptors of places from stored pyramids (pure)."""
