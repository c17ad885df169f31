"""Ground truth beside a recording: ours, or somebody else's files of the same name."""

from dataclasses import dataclass, field
from typing import Any

from prior_sg.deploy.truth import GroundTruth, TrueObject, read_objects
from prior_sg.services.ingest.core.inspection.findings import Finding, note, ok
from prior_sg.services.ingest.sources import Source

WITHOUT = "the run goes on without those scores"


@dataclass(frozen=True)
class Beside:
    """What can be judged against, and what was said about it."""

    regions: dict[str, Any] | None = None  # content of regions.json
    objects: tuple[TrueObject, ...] = ()
    findings: list[Finding] = field(default_factory=list)


def truth_beside(source: Source) -> Beside:
    """The ground truth of a source; files of another layout are named and left out."""
    findings: list[Finding] = []
    regions, objects = source.ground_truth, tuple[TrueObject, ...]()
    if regions is not None:
        try:
            count = len(GroundTruth.from_json(regions).regions)
            findings.append(ok("ground truth", f"regions.json names {count} regions"))
        except (ValueError, AttributeError, IndexError) as error:
            findings.append(_foreign("regions.json", error))
            regions = None
    try:
        objects = read_objects(source.path, source.origin_m)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        findings.append(_foreign("objects.json", error))
    if objects:
        findings.append(ok("ground truth", f"objects.json names {len(objects)} objects"))
    return Beside(regions, objects, findings)


def _foreign(name: str, error: Exception) -> Finding:
    if isinstance(error, OSError):
        return note("ground truth", f"{name} cannot be read ({error.strerror}), and is left out", WITHOUT)
    return note("ground truth", f"{name} is not in the layout of docs/sources.md, and is left out", WITHOUT)
