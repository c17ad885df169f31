"""`prior-sg priors`: make, show, compare and exchange prior graphs; here their options."""

import argparse
from pathlib import Path

from prior_sg.deploy.cli.shared import Commands, add_bus, add_settings, console

WHAT = "a JSON file, or the digest of a kept prior or its beginning"


def add_commands(commands: Commands) -> None:
    """`priors` and its actions."""
    parser = commands.add(
        "priors", _run, "make, show, compare and exchange prior graphs", "prior-sg priors list", "map"
    )
    actions = Commands(parser, "action", "ACTION", "prior-sg priors ")

    def action(name: str, summary: str, example: str) -> argparse.ArgumentParser:
        return actions.add(name, _run, summary, example, "map")

    add_settings(action("list", "list the curated library and the kept priors", "list"))
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
    bring.add_argument("--vouch", action="store_true", help="stand for it, whoever has signed it or nobody")
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
        add_settings(one)


def _add_task(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--environment", default="", help="what kind of place it is, in plain words")
    parser.add_argument("--task", default="", help="what the robot is to do, in plain words")
    parser.add_argument("--regions", default="", help="fixed region names, separated by commas")


def _run(arguments: argparse.Namespace) -> int:
    from prior_sg.deploy.cli.prior_actions import ACTIONS

    return ACTIONS[arguments.action](arguments, console)
