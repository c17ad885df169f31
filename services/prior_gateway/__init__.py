"""Answers a task with a prior graph."""
