"""Command line, evaluation and deployment."""
