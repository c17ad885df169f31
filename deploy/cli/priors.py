"""`prior-sg priors`: make, show, compare and exchange prior graphs."""

import argparse
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from prior_sg.deploy.running.inprocess import InProcess
from prior_sg.deploy.settings import resolved_config
from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.priors import ObjectPrior, Prior, PriorRevision, Provenance, RegionPrior, Spread, Task
from prior_sg.schemas.topics import PRIOR, PRIOR_REVISION
from prior_sg.services.prior_gateway.core.compose import Config, Library, NoPrior
from prior_sg.services.prior_gateway.outside.archive import PREFERRED, Archive
from prior_sg.services.prior_gateway.outside.library import environments, load
from prior_sg.services.prior_gateway.outside.signing import Signer
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.bus import Bus, LocalBus, Sample
from prior_sg.services.runtime.client import BusClient, NoPriorError

FORMAT = "prior-sg prior 1"
LIBRARY_SIGN = "made by the curated library of this version"
Rows = Mapping[str, Mapping[str, float]]


class PriorError(Exception):
    """What was asked of a prior cannot be done; the message says what to do instead."""


class PriorFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A prior as people read and write it; matrices by name, probabilities as decimals."""

    format: str
    environment: str
    task: str
    vocabulary: list[str]
    regions: list[RegionPrior]
    objects: list[ObjectPrior]
    containment: dict[str, dict[str, float]]
    adjacency: dict[str, dict[str, float]]
    provenance: Provenance
    spread: dict[str, Any] | None = None


def add_arguments(parser: argparse.ArgumentParser, add_bus: Callable[..., None]) -> None:
    """What `prior-sg priors` can be told."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    def action(name: str, summary: str, example: str) -> argparse.ArgumentParser:
        return actions.add_parser(
            name,
            help=summary,
            description=summary,
            epilog=f"example: prior-sg priors {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    _add_settings(action("list", "list the curated library and the kept priors", "list"))
    make = action(
        "make",
        "make a prior with the configured model or the library, and keep it",
        'make --environment "residential home" --task "serve drinks" --set prior_gateway.provider=openai '
        "--set prior_gateway.endpoint=http://127.0.0.1:8000/v1 --set prior_gateway.model=llama --out prior.json",
    )
    make.add_argument("--timeout", type=float, default=900.0, help="seconds to wait for it (default: %(default)s)")
    make.add_argument("--out", type=Path, help="write it as JSON")
    show = action(
        "show", "print a prior, and draw its graph and matrices", 'show --environment "office floor" --out prior.svg'
    )
    show.add_argument("--out", type=Path, help="draw it as .svg or .png")
    diff = action("diff", "compare two priors", "diff before.json after.json")
    diff.add_argument("what", help=WHAT)
    diff.add_argument("other", help=WHAT)
    diff.add_argument("--least", type=float, default=0.1, help="smallest difference told (default: %(default)s)")
    bring = action("import", "check a prior from a file and let it answer its task from now on", "import prior.json")
    bring.add_argument("file", type=Path, help="JSON as `export` writes it")
    export = action(
        "export", "write a prior as JSON", 'export --environment "campus" --task "delivery" --out prior.json'
    )
    export.add_argument("--out", type=Path, required=True, help="the file to write")
    revise = action(
        "revise",
        "ask the running gateway to revise a prior from what robots have observed",
        'revise --environment "residential home" --task "serve drinks"',
    )
    revise.add_argument("--by-model", action="store_true", help="let the model weigh the observations")
    revise.add_argument("--timeout", type=float, default=60.0, help="seconds to wait for it (default: %(default)s)")
    add_bus(revise, robot=False)
    for one in (show, export):
        one.add_argument("what", nargs="?", default="", help=WHAT)
    for one in (make, show, export, revise):
        _add_task(one)
    for one in (make, show, diff, bring, export):
        _add_settings(one)


WHAT = "a JSON file, or the digest of a kept prior or its beginning"


def _add_task(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--environment", default="", help="what kind of place it is, in plain words")
    parser.add_argument("--task", default="", help="what the robot is to do, in plain words")
    parser.add_argument("--regions", default="", help="fixed region names, separated by commas")


def _add_settings(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", default="", help="TOML file with a section per service")
    parser.add_argument("--set", action="append", default=[], metavar="SERVICE.FIELD=VALUE", help="one setting")


def run(arguments: argparse.Namespace, console: Console, open_bus: Callable[[str], Bus]) -> int:
    """Do what was asked; exit status. Raises PriorError."""
    if arguments.action == "revise":
        return revise(arguments, console, open_bus)
    return ACTIONS[arguments.action](arguments, console)


def settings(arguments: argparse.Namespace) -> Config:
    """The gateway's configuration."""
    return resolved_config(BY_NAME["prior_gateway"], arguments.config, arguments.set)


def task_of(arguments: argparse.Namespace) -> Task:
    """The task that the options name."""
    if not arguments.environment:
        raise PriorError("name an environment with --environment, or a file or digest")
    regions = [name.strip() for name in arguments.regions.split(",") if name.strip()]
    return Task(
        robot="cli", stamp_ns=time.time_ns(), environment=arguments.environment, task=arguments.task, regions=regions
    )


def find(what: str, cfg: Config) -> Prior:
    """The prior in a file, or the kept one of a digest. Raises PriorError."""
    if Path(what).is_file():
        return read(Path(what))
    found = {entry.prior.digest(): entry.prior for _, entry in Archive(cfg.archive).all()}
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
    kept = [(name == PREFERRED, entry.prior) for name, entry in Archive(cfg.archive).all() if entry.prior.answers(task)]
    if kept:
        return max(kept, key=lambda pair: pair[0])[1]
    try:
        return load().answer(task, cfg)
    except NoPrior as reason:
        raise PriorError(str(reason)) from reason


def verdict(prior: Prior, cfg: Config, library: Library) -> str:
    """What speaks for a prior's origin."""
    if not prior.provenance.signature and prior.provenance.source == "library" and not prior.provenance.parent_digest:
        task = Task(robot="", stamp_ns=0, environment=prior.environment, task=prior.task, regions=prior.vocabulary)
        try:
            said = library.answer(task, cfg)
            same = msgspec.structs.replace(said, provenance=prior.provenance).digest() == prior.digest()
        except NoPrior:
            same = False
        return LIBRARY_SIGN if same else "not signed, and not what this version's library says"
    return Signer(cfg.signing_key, cfg.trusted_keys).check(prior)[1]


def make(arguments: argparse.Namespace, console: Console) -> int:
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
        write(prior, arguments.out)
        console.print(f"written to {arguments.out}")
    return 0


def show(arguments: argparse.Namespace, console: Console) -> int:
    """Tables, and a picture."""
    from prior_sg.deploy.showing.prior import draw

    cfg = settings(arguments)
    prior = wanted(arguments, cfg)
    describe(prior, cfg, console)
    if arguments.out:
        try:
            draw(prior, arguments.out)
        except (ValueError, OSError) as error:
            raise PriorError(f"cannot draw {arguments.out}: {error}") from error
        console.print(f"drawn in {arguments.out}")
    return 0


def export(arguments: argparse.Namespace, console: Console) -> int:
    """JSON that `import` reads."""
    prior = wanted(arguments, settings(arguments))
    write(prior, arguments.out)
    console.print(f"prior {prior.digest()} written to {arguments.out}")
    return 0


def bring(arguments: argparse.Namespace, console: Console) -> int:
    """A prior from elsewhere is checked like a model's."""
    cfg, prior = settings(arguments), read(arguments.file)
    said = verdict(prior, cfg, load())
    if cfg.require_signature and not Signer(cfg.signing_key, cfg.trusted_keys).check(prior)[0]:
        raise PriorError(f"{arguments.file}: {said}; prior_gateway.require_signature lets no such prior in")
    if not cfg.archive:
        raise PriorError("there is no archive to import into; set prior_gateway.archive to a folder")
    Archive(cfg.archive).put(prior, PREFERRED, verdict=said)
    console.print(f"prior {prior.digest()} ({said}) answers {prior.task!r} in {prior.environment!r} from now on")
    return 0


def list_all(arguments: argparse.Namespace, console: Console) -> int:
    """The library, then what the archive holds."""
    table = Table("environment", "task", "regions", show_lines=True)
    for listing in environments():
        for task, regions in listing.tasks.items():
            table.add_row(listing.name, task, ", ".join(regions))
    console.print(table)
    cfg = settings(arguments)
    kept = list(Archive(cfg.archive).all())
    if kept:
        table = Table(title=f"kept in {cfg.archive}")
        table.add_column("digest", no_wrap=True)
        for column in ("environment", "task", "from", "regions", "signature"):
            table.add_column(column)
        for name, entry in kept:
            prior = entry.prior
            source = prior.provenance.source + (" (in force)" if name == PREFERRED else "")
            table.add_row(
                prior.digest()[:12], prior.environment, prior.task, source, str(len(prior.regions)), entry.verdict
            )
        console.print(table)
    return 0


def diff(arguments: argparse.Namespace, console: Console) -> int:
    """What one prior has and the other has not, and where they differ."""
    cfg = settings(arguments)
    before, after = find(arguments.what, cfg), find(arguments.other, cfg)
    lines = differences(before, after, arguments.least)
    for line in lines:
        console.print(line)
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
        ("P(r)", _existence(before), _existence(after)),
        ("P(o | r)", _held(before), _held(after)),
        ("P(ri - rj)", _touching(before), _touching(after)),
    )
    for title, old_rows, new_rows in matrices:
        for row in old_rows.keys() & new_rows.keys():
            for column in old_rows[row].keys() & new_rows[row].keys():
                was, now = old_rows[row][column], new_rows[row][column]
                if abs(now - was) >= least:
                    found.append((-abs(now - was), f"{title} {row}, {column}: {was:.2f} -> {now:.2f}"))
    return lines + [line for _, line in sorted(found)]


def revise(arguments: argparse.Namespace, console: Console, open_bus: Callable[[str], Bus]) -> int:
    """The running gateway revises and publishes; robots that work under the prior take it over at once."""
    task = task_of(arguments)
    found: list[Prior] = []

    def see(sample: Sample) -> None:
        try:
            prior = decode(Prior, sample.payload)
        except DecodeError:
            return
        if prior.answers(task) and prior.provenance.parent_digest and sample.sent_ns > given_ns:
            found.append(prior)

    given_ns = time.time_ns()
    with BusClient(open_bus(arguments.connect)) as client, console.status("revising"):
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


def describe(prior: Prior, cfg: Config, console: Console) -> None:
    """Each region with what tells it from the others, and where the prior comes from."""
    from prior_sg.deploy.showing.prior import merits

    merit = merits(prior)
    for i, region in enumerate(prior.regions):
        best = [j for j in np.argsort(-merit[i], kind="stable")[:5] if merit[i, j] > 0]
        near = [j for j in np.argsort(-prior.adjacency[i], kind="stable") if j != i][:4]
        share = _with_spread(region.existence, prior.spread.existence[i] if prior.spread else None)
        slope = f"{np.degrees(region.inclination_mean_rad):.0f}±{np.degrees(region.inclination_std_rad):.0f}° steep"
        zone = f", {region.parent}" if region.parent else ""
        console.print(
            f"[bold]{region.name}[/]  {share} of the places{zone}, {slope}, r_Q {region.query_radius_m:.2f} m"
        )
        console.print("    holds " + ", ".join(f"{prior.objects[j].name} {prior.containment[i, j]:.0%}" for j in best))
        console.print("    touches " + ", ".join(f"{prior.regions[j].name} {prior.adjacency[i, j]:.0%}" for j in near))
        console.print("    looks like " + "; ".join(region.phrases[:3]))
    if sized := [_size(item) for item in prior.objects if item.size_m is not None]:
        console.print("[bold]sizes[/]  " + ", ".join(sized))
    made = prior.provenance
    console.print(f"prior {prior.digest()}: {len(prior.regions)} regions, {len(prior.objects)} objects")
    console.print(f"made by {made.source} ({made.detail}){_when(made)}: {made.note}")
    console.print(f"origin: {verdict(prior, cfg, load())}")
    if made.parent_digest:
        console.print(f"revises {made.parent_digest}")


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


def _rows(names: list[str], columns: list[str], matrix: np.ndarray) -> dict[str, dict[str, float]]:
    """By name; decimals as short as they can be and still give the same 32-bit number."""
    return {
        name: {column: float(str(value)) for column, value in zip(columns, row, strict=True)}
        for name, row in zip(names, matrix.astype(np.float32), strict=True)
    }


def _regions(prior: Prior) -> list[str]:
    return [region.name for region in prior.regions]


def _existence(prior: Prior) -> Rows:
    return {region.name: {"share": region.existence} for region in prior.regions}


def _held(prior: Prior) -> dict[str, dict[str, float]]:
    return _rows(_regions(prior), [item.name for item in prior.objects], prior.containment)


def _touching(prior: Prior) -> dict[str, dict[str, float]]:
    return _rows(_regions(prior), _regions(prior), prior.adjacency)


def write(prior: Prior, path: Path) -> None:
    """Write as JSON. Raises PriorError."""
    spread = None
    if prior.spread is not None:
        spread = {name: np.asarray(getattr(prior.spread, name)).tolist() for name in Spread.__struct_fields__}
    file = PriorFile(
        format=FORMAT,
        environment=prior.environment,
        task=prior.task,
        vocabulary=prior.vocabulary,
        regions=prior.regions,
        objects=prior.objects,
        containment=_held(prior),
        adjacency=_touching(prior),
        provenance=prior.provenance,
        spread=spread,
    )
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(file), indent=1) + b"\n")
    except OSError as error:
        raise PriorError(f"cannot write {path} ({error.strerror}); choose another file with --out") from error


def read(path: Path) -> Prior:
    """Read JSON, with every check that a model's answer meets. Raises PriorError."""
    try:
        file = msgspec.json.decode(path.read_bytes(), type=PriorFile)
        if file.format != FORMAT:
            raise ValueError(f"its format is {file.format!r}, not {FORMAT!r}")
        regions = [region.name for region in file.regions]
        spread = None
        if file.spread is not None:
            spread = Spread(**{name: np.array(values, np.float32) for name, values in file.spread.items()})
        return Prior(
            environment=file.environment,
            task=file.task,
            vocabulary=file.vocabulary,
            regions=file.regions,
            objects=file.objects,
            containment=_matrix(file.containment, regions, [item.name for item in file.objects]),
            adjacency=_matrix(file.adjacency, regions, regions),
            provenance=file.provenance,
            spread=spread,
        )
    except (OSError, msgspec.MsgspecError, ValueError, TypeError) as error:
        raise PriorError(f"{path} is no usable prior: {error}") from error


def _matrix(rows: Rows, names: list[str], columns: list[str]) -> np.ndarray:
    if missing := [f"{row}, {column}" for row in names for column in columns if column not in rows.get(row, {})]:
        raise ValueError(f"a matrix lacks {missing[0]}")
    return np.array([[rows[row][column] for column in columns] for row in names], np.float32).reshape(
        len(names), len(columns)
    )


ACTIONS: dict[str, Callable[[argparse.Namespace, Console], int]] = {
    "list": list_all,
    "make": make,
    "show": show,
    "diff": diff,
    "import": bring,
    "export": export,
}
