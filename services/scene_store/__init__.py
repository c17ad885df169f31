"""Keeps the scene graph, durably."""
