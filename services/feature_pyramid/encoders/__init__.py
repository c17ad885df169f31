"""Encoders: images and texts into one embedding space."""
