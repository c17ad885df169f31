"""Turns keyframes into a graph of free-space places."""
