"""`warm`: what would be made at first use is made now."""

import argparse

from prior_sg.deploy.cli.shared import Commands, console, hush_logs


def add_commands(commands: Commands) -> None:
    """`warm`."""
    commands.add(
        "warm",
        cmd_warm,
        "compile the inner loops now, once, instead of while the first frames wait",
        "prior-sg warm",
        needs="map",
    )


def cmd_warm(arguments: argparse.Namespace) -> int:
    """Compile, and say how much of it there was to do."""
    from rich.progress import BarColumn, Progress, TimeElapsedColumn

    from prior_sg.deploy.running.warm import warm
    from prior_sg.deploy.terminal import Description

    hush_logs()
    with Progress(Description(), BarColumn(), TimeElapsedColumn(), console=console) as progress:
        bar = progress.add_task("compiling inner loops")
        done = warm(lambda frames, whole: progress.update(bar, total=whole, completed=frames))
    console.print(f"{done.made} loops compiled, {done.read} were kept from before ({done.seconds:.0f} s)")
    return 0
