"""From a sample of a recording to a list of findings (pure)."""

from dataclasses import replace

import msgspec

from prior_sg.services.ingest.core.inspection import conventions, gravity, pictures, registration, stream
from prior_sg.services.ingest.core.inspection.conventions import Reading
from prior_sg.services.ingest.core.inspection.findings import Finding, problems
from prior_sg.services.ingest.core.inspection.sample import Picker, Recording, Shot

CONSEQUENCES = ("keyframes", "motion")
__all__ = ["Finding", "Picker", "Reading", "Recording", "Shot", "inspect", "problems"]


def inspect(recording: Recording, reading: Reading, *, thorough: bool = True) -> list[Finding]:
    """Everything the sample says; without `thorough` colour is not looked at."""
    found = [*stream.judge(recording), *pictures.judge(recording)]
    if not recording.shots or any(finding.hopeless for finding in found):
        return found
    judged = conventions.judge(recording.shots, reading, recording.depth_unit_m)
    if judged.blind:
        return found + judged.findings
    views = [
        replace(shot.view(judged.factor), world_from_camera=pose)
        for shot, pose in zip(recording.shots, judged.poses, strict=True)
    ]
    if any(finding.verdict == "problem" for finding in judged.findings):
        found = [_following(finding) for finding in found]
    found += [*judged.findings, *gravity.judge(views, reading.world_from_source)]
    return found + (registration.judge(recording.shots) if thorough else [])


def _following(finding: Finding) -> Finding:
    """Jumps and speeds under poses that were read wrongly say nothing about the recording."""
    if finding.topic not in CONSEQUENCES or finding.verdict != "problem":
        return finding
    return msgspec.structs.replace(finding, verdict="note", mend="look again when the poses are mended")
