"""Depth from one picture: a network's output becomes metres by what the camera's own movement shows."""
