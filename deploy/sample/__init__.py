"""The sample recording: a home of 86 frames, in full in a checkout and coarser in what is installed."""

from pathlib import Path

FULL = Path(__file__).parent / "home.mcap"  # 640 x 480, exact depth; not in the wheel
COARSE = Path(__file__).parent / "home_coarse.mcap"  # as many pixels, stronger compression, depth in steps of 2 cm
SAMPLE = FULL if FULL.exists() else COARSE
