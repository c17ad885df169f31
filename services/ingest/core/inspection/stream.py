"""Frames, stamps and motion of a whole recording (pure)."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.ingest.core.inspection.findings import Finding, note, ok, problem
from prior_sg.services.ingest.core.inspection.sample import Recording

USUAL_HZ = (0.05, 200.0)
GAP = 10.0  # median spacings that make a pause
GAP_S = 2.0
FAST_M_S = 10.0  # what the selection refuses by default
FAST_TURN_DEG_S = 720.0
REFUSED_PROBLEM = 0.2  # share of frames
FAR_AWAY_M = 5000.0  # beyond, maps lose precision
REASONS = 3  # told at most


def judge(recording: Recording) -> list[Finding]:
    """Findings about everything but the images."""
    return [_frames(recording), *_selected(recording), *_stamps(recording), *_motion(recording), *_place(recording)]


def _frames(recording: Recording) -> Finding:
    good, bad = len(recording.frame_ids), recording.unreadable.total()
    if not recording.read:
        return problem("frames", "there are none", "give a recording with frames", hopeless=True)
    said = f"{good} of {recording.read} can be read"
    if recording.total > recording.read:
        said += f" (of {recording.total} the first {recording.read} were looked at)"
    if not bad:
        return ok("frames", said)
    said += f"; {bad} cannot: {_reasons(recording.unreadable)}"
    if not good:
        return problem("frames", said, _mend_of(recording.unreadable), hopeless=True)
    share = bad / recording.read
    return problem("frames", said, _mend_of(recording.unreadable)) if share > REFUSED_PROBLEM else note("frames", said)


def _mend_of(reasons: Mapping[str, int]) -> str:
    """What to do about the commonest reason."""
    top = max(reasons, key=lambda reason: reasons[reason])
    if "within" in top or "stamp" in top:
        return "--stamp-offset SECONDS moves the poses' stamps; --rate HZ ignores stamps"
    if "pixels" in top and "image" in top:
        return "colour, depth and intrinsics must belong to one image size: --intrinsics fx,fy,cx,cy,width,height"
    if "pose" in top or "rotation" in top or "orthonormal" in top:
        return "write rigid 4 x 4 poses or unit quaternions"
    return "mend or leave out these files"


def _selected(recording: Recording) -> list[Finding]:
    refused = recording.refused.total()
    good = len(recording.frame_ids)
    if not good:
        return []
    said = f"{recording.keyframes} with the default selection"
    if not refused:
        return [ok("keyframes", said)]
    text = f"{said}; {refused} of {good} frames are refused: {_reasons(recording.refused)}"
    return [
        problem("keyframes", text, "--rate HZ ignores the stamps")
        if refused > REFUSED_PROBLEM * good
        else note("keyframes", text)
    ]


def _stamps(recording: Recording) -> list[Finding]:
    stamps_s = np.array(recording.stamps_ns, float) / 1e9
    if len(stamps_s) < 2:
        return []
    others = np.array([one != other for one, other in pairwise(recording.cameras)], bool)
    steps_s = np.diff(stamps_s)
    back, same = int((steps_s < 0).sum()), int(((steps_s == 0) & ~others).sum())
    rising_s = steps_s[steps_s > 0]
    if not len(rising_s):
        return [problem("stamps", "they do not rise", "--rate HZ gives the frames stamps of their own")]
    median_s = float(np.median(rising_s))
    said = f"{1 / median_s:.3g} Hz over {rising_s.sum():.1f} s"
    if not USUAL_HZ[0] <= 1 / median_s <= USUAL_HZ[1]:
        return [problem("stamps", f"{said} is no frame rate: their unit is another", "--stamp-unit, or --rate HZ")]
    gaps = rising_s[(rising_s > GAP * median_s) & (rising_s > GAP_S)]
    parts = [f"{back} go back"] if back else []
    parts += [f"{same} repeat"] if same else []
    parts += [f"{len(gaps)} pauses, the longest {gaps.max():.1f} s"] if len(gaps) else []
    if not parts:
        return [ok("stamps", said)]
    return [note("stamps", f"{said}; {', '.join(parts)}", "--rate HZ ignores them" if back or same else "")]


def _motion(recording: Recording) -> list[Finding]:
    poses, pairs = recording.world_from_camera, _neighbours(recording.cameras)
    if not pairs:
        return []
    before, after = map(list, zip(*pairs, strict=True))
    stamps_s = np.array(recording.stamps_ns, float) / 1e9
    positions_m = np.stack([pose[:3, 3] for pose in poses])
    steps_m = np.linalg.norm(positions_m[after] - positions_m[before], axis=1)
    turns_deg = np.degrees([rotation_angle_rad(inverse(poses[a]) @ poses[b]) for a, b in pairs])
    gone_s = stamps_s[after] - stamps_s[before]
    spacing_s, forward = np.maximum(gone_s, 1e-9), gone_s > 0
    speeds, turn_speeds = (steps_m / spacing_s)[forward], (turns_deg / spacing_s)[forward]
    said = f"{steps_m.sum():.1f} m, median {_median(speeds):.2f} m/s and {_median(turn_speeds):.0f} degrees/s"
    if steps_m.sum() < 1e-3 and turns_deg.sum() < 0.1:
        return [note("motion", "the camera rests throughout", "check that every frame has a pose of its own")]
    if _median(speeds) > FAST_M_S:
        mend = "--rate HZ if the stamps are wrong; --position-scale METRES if positions are in another unit"
        return [problem("motion", f"{said} is faster than a camera moves", mend)]
    jumps = int((speeds > FAST_M_S).sum())
    if jumps:
        return [note("motion", f"{said}; it jumps {jumps} times, at most {steps_m.max():.2f} m")]
    return [ok("motion", said)]


def _neighbours(cameras: Sequence[str]) -> list[tuple[int, int]]:
    """Positions of each frame and the next one of its camera."""
    last: dict[str, int] = {}
    pairs = []
    for position, camera in enumerate(cameras):
        if camera in last:
            pairs.append((last[camera], position))
        last[camera] = position
    return pairs


def _place(recording: Recording) -> list[Finding]:
    if not recording.world_from_camera:
        return []
    away_m = float(np.abs(np.median([pose[:3, 3] for pose in recording.world_from_camera], axis=0)).max())
    if away_m < FAR_AWAY_M:
        return []
    return [
        problem("origin", f"the positions lie {away_m / 1000:,.0f} km from the origin of their world", "--origin auto")
    ]


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _reasons(counts: Mapping[str, int]) -> str:
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    said = "; ".join(f"{count} × {reason}" for reason, count in ordered[:REASONS])
    return said + (f"; {len(ordered) - REASONS} more reasons" if len(ordered) > REASONS else "")
