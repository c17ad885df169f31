"""What `prior-sg priors` does."""

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from prior_sg.deploy.cli.prior_file import PriorError, Rows, adjacency, containment, existence, read, write
from prior_sg.deploy.cli.shared import open_client
from prior_sg.deploy.edge import names_in
from prior_sg.deploy.errors import UsageError
from prior_sg.deploy.running.inprocess import InProcess
from prior_sg.deploy.settings import resolved_config
from prior_sg.deploy.terminal import Table, Terminal, line
from prior_sg.schemas.codec import DecodeError
from prior_sg.schemas.priors import ObjectPrior, Prior, PriorRevision, Provenance, Task
from prior_sg.schemas.topics import PRIOR, PRIOR_REVISION
from prior_sg.services.errors import reason_of
from prior_sg.services.prior_gateway.core.compose import Library, NoPrior
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.outside.archive import PREFERRED, PriorShelf
from prior_sg.services.prior_gateway.outside.library import environments, load
from prior_sg.services.prior_gateway.outside.signing import Signer
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.bus import LocalBus, Sample, message_in
from prior_sg.services.runtime.client import BusClient, NoPriorError
from prior_sg.services.runtime.signatures import signatures_in_force

LIBRARY_SIGN = "made by the curated library of this version"


def settings(arguments: argparse.Namespace) -> Config:
    """The gateway's configuration."""
    return resolved_config(BY_NAME["prior_gateway"], arguments.config, arguments.set)


def task_of(arguments: argparse.Namespace) -> Task:
    """The task that the options name."""
    if not arguments.environment:
        raise UsageError("name an environment with --environment, or a file or digest")
    return Task(
        robot="cli",
        stamp_ns=time.time_ns(),
        environment=arguments.environment,
        task=arguments.task,
        regions=names_in(arguments.regions),
    )


def find(what: str, cfg: Config) -> Prior:
    """The prior in a file, or the kept one of a digest. Raises PriorError."""
    if Path(what).is_file():
        return read(Path(what))
    found = {entry.prior.digest(): entry.prior for _, entry in PriorShelf(cfg.archive).all()}
    fitting = [digest for digest in found if len(what) >= 4 and digest.startswith(what)]
    if len(fitting) != 1:
        raise PriorError(
            f"{what} is no file, and {len(fitting) or 'no'} kept priors have such a digest; see `priors list`"
        )
    return found[fitting[0]]


def wanted(arguments: argparse.Namespace, cfg: Config) -> Prior:
    """The prior that `what` names, else the one that answers the task: a kept one, else the library's."""
    if arguments.what:
        return find(arguments.what, cfg)
    task = task_of(arguments)
    kept = [
        (name == PREFERRED, entry.prior) for name, entry in PriorShelf(cfg.archive).all() if entry.prior.answers(task)
    ]
    if kept:
        return max(kept, key=lambda pair: pair[0])[1]
    try:
        return load().answer(task, cfg)
    except NoPrior as reason:
        raise PriorError(str(reason)) from reason


def verdict(prior: Prior, cfg: Config, library: Library) -> str:
    """What speaks for a prior's origin."""
    if not prior.provenance.signature and prior.provenance.source == "library" and not prior.provenance.parent_digest:
        task = Task(robot="cli", stamp_ns=0, environment=prior.environment, task=prior.task, regions=prior.vocabulary)
        try:
            said = library.answer(task, cfg)
            same = msgspec.structs.replace(said, provenance=prior.provenance).digest() == prior.digest()
        except NoPrior:
            same = False
        return LIBRARY_SIGN if same else "not signed, and not what this version's library says"
    return Signer(cfg).check(prior)[1]


def make(arguments: argparse.Namespace, console: Terminal) -> int:
    """A gateway in this process does exactly what the service does."""
    cfg, task = settings(arguments), task_of(arguments)
    gateway = InProcess("cli", Path(), list(arguments.set), arguments.config)
    gateway.start("prior_gateway")
    try:
        with BusClient(LocalBus(gateway.hub)) as client, console.status("asking for the prior") as status:
            while "prior_gateway" not in client.alive(0.05).values():
                gateway.check()
            prior = client.give_task(task, arguments.timeout, lambda reason: status.update(reason or "asking"))
    except NoPriorError as error:
        raise PriorError(str(error)) from error
    finally:
        gateway.stop()
    describe(prior, cfg, console)
    if arguments.out:
        write(_signed(prior), arguments.out)
        console.print(f"written to {arguments.out}")
    return 0


def show(arguments: argparse.Namespace, console: Terminal) -> int:
    """Tables, and a picture."""
    from prior_sg.deploy.showing.prior import draw

    cfg = settings(arguments)
    prior = wanted(arguments, cfg)
    describe(prior, cfg, console)
    if arguments.out:
        try:
            draw(prior, arguments.out)
        except (ValueError, OSError) as error:
            raise PriorError(f"cannot draw {arguments.out}: {reason_of(error)}") from error
        console.print(f"drawn in {arguments.out}")
    return 0


def export(arguments: argparse.Namespace, console: Terminal) -> int:
    """JSON that `import` reads."""
    prior = _signed(wanted(arguments, settings(arguments)))
    write(prior, arguments.out)
    console.print(f"prior {prior.digest()} written to {arguments.out}")
    return 0


def _signed(prior: Prior) -> Prior:
    """For others of the fleet, where keys are in force; else as it is: another signature may stand there."""
    signed = signatures_in_force().signed(prior)
    assert isinstance(signed, Prior)
    return signed


def bring(arguments: argparse.Namespace, console: Terminal) -> int:
    """A prior from elsewhere is checked like a model's."""
    cfg, prior = settings(arguments), read(arguments.file)
    said = verdict(prior, cfg, load())
    signer = Signer(cfg)
    if arguments.vouch:
        said = "vouched for when it was imported"
    elif signer.required and not signer.check(prior)[0]:
        raise PriorError(f"{arguments.file}: {said}; if you have read it and stand for it, import it with --vouch")
    if not cfg.archive:
        raise PriorError("there is no archive to import into; set prior_gateway.archive to a folder")
    if not PriorShelf(cfg.archive).put(prior, PREFERRED, verdict=said):
        raise PriorError(f"nothing is imported: {cfg.archive} cannot be written; set prior_gateway.archive to a folder")
    console.print(f"prior {prior.digest()} ({said}) answers {prior.task!r} in {prior.environment!r} from now on")
    return 0


def list_all(arguments: argparse.Namespace, console: Terminal) -> int:
    """The library, then what the archive holds."""
    rows = Table("environment", "task", "regions", show_lines=True)
    for listing in environments():
        for task, regions in listing.tasks.items():
            rows.add_row(listing.name, task, ", ".join(regions))
    console.print(rows)
    cfg = settings(arguments)
    kept = list(PriorShelf(cfg.archive).all())
    if kept:
        rows = Table(title=f"kept in {cfg.archive}")
        for name in ("digest", "environment", "task", "from", "regions", "signature"):
            rows.add_column(name, no_wrap=name == "digest")  # it is copied
        for name, entry in kept:
            prior = entry.prior
            source = prior.provenance.source + (" (in force)" if name == PREFERRED else "")
            rows.add_row(
                prior.digest()[:12], prior.environment, prior.task, source, str(len(prior.regions)), entry.verdict
            )
        console.print(rows)
    return 0


def diff(arguments: argparse.Namespace, console: Terminal) -> int:
    """What one prior has and the other has not, and where they differ."""
    cfg = settings(arguments)
    before, after = find(arguments.what, cfg), find(arguments.other, cfg)
    lines = differences(before, after, arguments.least)
    for text in lines:
        console.print(text)
    if not lines:
        console.print(f"no difference of {arguments.least:g} or more")
    return 0


def differences(before: Prior, after: Prior, least: float) -> list[str]:
    """One line per difference; entries whose names both have, by size."""
    lines = (
        [f"parent: {after.provenance.parent_digest[:12]}"] if after.provenance.parent_digest == before.digest() else []
    )
    kinds = (("region", before.regions, after.regions), ("object", before.objects, after.objects))
    for kind, old, new in kinds:
        names, others = [entry.name for entry in old], [entry.name for entry in new]  # type: ignore[attr-defined]
        lines += [f"- {kind} {name}" for name in names if name not in others]
        lines += [f"+ {kind} {name}" for name in others if name not in names]
    found = []
    matrices: tuple[tuple[str, Rows, Rows], ...] = (
        ("P(r)", existence(before), existence(after)),
        ("P(o | r)", containment(before), containment(after)),
        ("P(ri - rj)", adjacency(before), adjacency(after)),
    )
    for title, old_rows, new_rows in matrices:
        for row in old_rows.keys() & new_rows.keys():
            for column in old_rows[row].keys() & new_rows[row].keys():
                was, now = old_rows[row][column], new_rows[row][column]
                if abs(now - was) >= least:
                    found.append((-abs(now - was), f"{title} {row}, {column}: {was:.2f} -> {now:.2f}"))
    return lines + [text for _, text in sorted(found)]


def revise(arguments: argparse.Namespace, console: Terminal) -> int:
    """The running gateway revises and publishes; robots that work under the prior take it over at once."""
    task = task_of(arguments)
    found: list[Prior] = []

    def see(sample: Sample) -> None:
        try:
            prior: Prior = message_in(sample)
        except DecodeError:
            return
        revised = prior.answers(task) and prior.provenance.parent_digest and sample.sent_ns > given_ns
        if revised and not signatures.fault_of(prior):
            found.append(prior)

    given_ns, signatures = time.time_ns(), signatures_in_force()
    with open_client(arguments.connect) as client, console.status("revising"):
        client.listen(PRIOR, "*", see)
        client.publish(
            PRIOR_REVISION,
            PriorRevision(
                environment=task.environment, task=task.task, regions=task.regions, by_model=arguments.by_model
            ),
        )
        end_s = time.monotonic() + arguments.timeout
        while not found:
            if time.monotonic() > end_s:
                raise PriorError(
                    f"no revised prior within {arguments.timeout:.0f} s; has any robot observed regions under this very"
                    " task (`prior-sg health` shows PRIOR_EVIDENCE at prior_gateway)?"
                )
            time.sleep(0.1)
    console.print(f"{found[0].digest()} replaces {found[0].provenance.parent_digest}: {found[0].provenance.note}")
    return 0


def describe(prior: Prior, cfg: Config, console: Terminal) -> None:
    """Each region with what tells it from the others, and where the prior comes from."""
    from prior_sg.deploy.showing.prior import merits

    merit = merits(prior)
    for i, region in enumerate(prior.regions):
        best = [j for j in np.argsort(-merit[i], kind="stable") if merit[i, j] > 0]
        near = [j for j in np.argsort(-prior.adjacency[i], kind="stable") if j != i]
        held = [f"{prior.objects[j].name} {prior.containment[i, j]:.0%}" for j in best]
        touched = [f"{prior.regions[j].name} {prior.adjacency[i, j]:.0%}" for j in near]
        share = _with_spread(region.existence, prior.spread.existence[i] if prior.spread else None)
        slope = f"{np.degrees(region.inclination_mean_rad):.0f}±{np.degrees(region.inclination_std_rad):.0f}° steep"
        zone = f", {prior.zones[i]}" if prior.zones[i] else ""
        console.print(
            line(
                (region.name, "bold"),
                f"  {share} of the places{zone}, {slope}, r_Q {region.query_radius_m:.2f} m",
            )
        )
        for said, names, most, between in (
            ("holds", held, 5, ", "),
            ("touches", touched, 4, ", "),
            ("looks like", region.phrases, 3, "; "),
        ):
            if names:
                console.print(f"    {said} {some_of(names, most, between)}")
    if sized := [_size(item) for item in prior.objects if item.size_m is not None]:
        console.print(line(("sizes", "bold"), "  ", ", ".join(sized)))
    made = prior.provenance
    console.print(f"prior {prior.digest()}: {len(prior.regions)} regions, {len(prior.objects)} objects")
    console.print(f"made by {made.source} ({made.detail}){_when(made)}: {made.note}")
    console.print(f"origin: {verdict(prior, cfg, load())}")
    if made.parent_digest:
        first = f", which began with {made.root_digest}" if made.root_digest != made.parent_digest else ""
        console.print(f"revises {made.parent_digest}{first if made.root_digest else ''}")
    if made.contributors:
        console.print(f"by what was seen by {', '.join(made.contributors)}")


def some_of(names: Sequence[str], most: int, between: str = ", ") -> str:
    """The first of them, and how many are left out."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{between.join(names[:most])}{more}"


def _with_spread(value: float, spread: float | None) -> str:
    return f"{value:.0%}" + (f" ±{spread:.0%}" if spread is not None and spread >= 0.005 else "")


def _size(item: ObjectPrior) -> str:
    """Its name and sides in metres, and where its lower edge is if that is not the floor."""
    sides = "×".join(f"{side_m:.2g}" for side_m in item.size_m or ())
    return f"{item.name} {sides} m" + (f" at {item.bottom_m:.2g} m" if item.bottom_m else "")


def _when(made: Provenance) -> str:
    if not made.made_ns:
        return ""
    at = time.strftime("%Y-%m-%d %H:%M", time.localtime(made.made_ns / 1e9))
    return f" at {at} by {made.made_by}, prompts {made.prompts}, {made.samples} samples"


ACTIONS: dict[str, Callable[[argparse.Namespace, Terminal], int]] = {
    "list": list_all,
    "make": make,
    "show": show,
    "diff": diff,
    "import": bring,
    "export": export,
    "revise": revise,
}
