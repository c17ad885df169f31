"""Runs one service on a bus."""
