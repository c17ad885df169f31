"""The sample recording: a home of 86 frames."""

from pathlib import Path

SAMPLE = Path(__file__).parent / "home.mcap"
