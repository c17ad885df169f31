"""Turns keyframes into multi-scale embeddings; any number of workers."""
