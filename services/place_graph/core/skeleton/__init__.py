"""Distances, the Voronoi diagram, and the graph of places on it (pure)."""
