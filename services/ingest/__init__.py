"""Turns a source of posed RGB-D images into keyframes."""
