"""Processes and runs."""
