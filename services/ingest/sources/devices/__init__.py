"""Cameras at this computer, whose poses come from somebody else."""
