"""`prior-sg keys` and `prior-sg router`: who takes part beyond one host, and the router that lets them."""

import argparse
import json
import time
from pathlib import Path

from prior_sg.deploy.cli.shared import (
    Commands,
    Run,
    add_bus,
    add_router,
    console,
    open_client,
    reach_of,
    until_interrupted,
    wait,
    writing,
)
from prior_sg.deploy.errors import UsageError
from prior_sg.services.folders import user_settings

ROLES = ("robot", "edge", "fleet", "viewer", "operator")


def add_commands(commands: Commands) -> None:
    """`keys` and `router`."""
    parser = commands.add(
        "keys", _run, "certificates for robots, edge servers and consoles", "prior-sg keys init", needs="map"
    )
    actions = Commands(parser, "action", "ACTION", "prior-sg keys ")

    def action(name: str, does: Run, summary: str, example: str) -> argparse.ArgumentParser:
        one = actions.add(name, does, summary, example, "map")
        one.add_argument("--folder", type=Path, default=user_settings() / "keys", help="of the authority (%(default)s)")
        return one

    action("init", _init, "start an authority, which signs all other keys", "init")
    add = action(
        "add",
        _add,
        "make a bundle of keys: robot writes what is its own, edge runs services for all and lets others join, "
        "fleet merges maps under its own name, viewer reads, operator also gives tasks",
        "add robot robot7",
    )
    add.add_argument("role", choices=ROLES)
    add.add_argument("name", help="for a robot the one of --robot")
    revoke = action("revoke", _revoke, "let somebody take part no longer", "revoke robot7")
    rotate = action("rotate", _rotate, "give somebody a new key in place of the one before", "rotate robot7")
    for one in (revoke, rotate):
        one.add_argument("name")
    for one in (add, rotate):
        one.add_argument("--days", type=int, default=365, help="for which the certificate holds (default: %(default)s)")
    listing = action("list", _list, "who takes part, and until when", "list")
    listing.add_argument("--json", action="store_true", help="for programs")

    router = commands.add(
        "router",
        _router,
        "run a router by itself, or write its configuration for zenohd",
        "prior-sg router --keys edge1 --listen tls/0.0.0.0:7448",
        needs="map",
    )
    router.add_argument("--write", type=Path, metavar="FILE", help="write the configuration for zenohd and end")
    add_bus(router, robot=False)
    add_router(router)


def _run(arguments: argparse.Namespace) -> int:
    raise UsageError("name an action; `prior-sg keys --help` lists them")


def _init(arguments: argparse.Namespace) -> int:
    from prior_sg.deploy.keys.authority import Authority

    made = Authority.create(arguments.folder)
    console.print(f"authority in {made.folder}; next: `prior-sg keys add edge NAME`, `prior-sg keys add robot NAME`")
    return 0


def _add(arguments: argparse.Namespace) -> int:
    from prior_sg.deploy.keys.authority import Authority

    authority = Authority(arguments.folder)
    made = authority.add(arguments.role, arguments.name, arguments.days)
    console.print(
        f"{made.role} {made.name}, until {made.until}: copy {authority.bundle(made.name)} to its machine and name the "
        "copy with --keys"
    )
    return _told_others(arguments)


def _rotate(arguments: argparse.Namespace) -> int:
    from prior_sg.deploy.keys.authority import Authority

    authority = Authority(arguments.folder)
    made = authority.rotate(arguments.name, arguments.days)
    console.print(f"new keys of {made.name}, until {made.until}: copy {authority.bundle(made.name)} to its machine")
    return _told_others(arguments)


def _revoke(arguments: argparse.Namespace) -> int:
    from prior_sg.deploy.keys.authority import Authority

    revoked = Authority(arguments.folder).revoke(arguments.name)
    console.print(f"{revoked.name} is revoked")
    return _told_others(arguments)


def _told_others(arguments: argparse.Namespace) -> int:
    """Routers know from their bundles who takes part, and all who read priors whose signatures count."""
    from prior_sg.deploy.keys.authority import Authority
    from prior_sg.services.runtime.signatures import SIGNERS

    authority = Authority(arguments.folder)
    there = [one for one in authority.participants.values() if one.name != arguments.name and not one.revoked]
    signs = authority.participants[arguments.name].role in SIGNERS
    others = [one.name for one in there if one.role == "edge" or signs]
    if others:
        files = ", ".join(str(authority.bundle(name) / "bundle.json") for name in others)
        console.print(f"{', '.join(others)} must know: copy {files} there and start routers again")
    return 0


def _list(arguments: argparse.Namespace) -> int:
    import msgspec

    from prior_sg.deploy.keys.authority import Authority
    from prior_sg.deploy.terminal import Table

    authority = Authority(arguments.folder)
    everybody = sorted(authority.participants.values(), key=lambda one: (one.role, one.name))
    if arguments.json:
        print(msgspec.json.encode(everybody).decode())
        return 0
    rows = Table("name", "role", "key", "until", "state")
    today = time.strftime("%Y-%m-%d", time.gmtime())
    for one in everybody:
        rows.add_row(one.name, one.role, str(one.issue), one.until, one.state(today))
    console.print(rows)
    return 0


def _router(arguments: argparse.Namespace) -> int:
    from prior_sg.services.runtime.hearing import end_deaf
    from prior_sg.services.runtime.zenoh_router import check_router, open_router, router_settings

    beyond = reach_of(arguments)
    if arguments.write is not None:
        check_router(arguments.connect, beyond)
        with writing(arguments.write):
            arguments.write.write_text(json.dumps(router_settings(arguments.connect, beyond), indent=1) + "\n")
        console.print(f"wrote {arguments.write}; start it with `zenohd -c {arguments.write}`")
        return 0
    stop = open_router(arguments.connect, beyond)
    try:
        with until_interrupted(), open_client(arguments.connect, on_deaf=end_deaf):
            console.print(f"router {' and '.join((arguments.connect, *arguments.listen))}; Ctrl-C stops")
            wait()
        return 0
    finally:
        stop()
