"""Where things lie."""

from pathlib import Path

from prior_sg.deploy.sample import SAMPLE as SAMPLE

ROOT = Path(__file__).resolve().parents[2]
SHARED_DATA = ROOT.parent / "shared" / "data"  # absent outside the founders' machines: what needs it skips
