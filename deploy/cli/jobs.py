"""Commands that do the main job: on the sample, and on a source of the user's."""

import argparse
from pathlib import Path

from prior_sg.deploy.cli.check import before_start
from prior_sg.deploy.cli.shared import Commands, add_bus, add_log_mb, add_settings, console
from prior_sg.deploy.cli.source_options import add_source_options, mapping_options, read_options, source_settings
from prior_sg.deploy.edge import names_in
from prior_sg.deploy.errors import UsageError, UserError
from prior_sg.deploy.interrupts import EXIT_INTERRUPTED
from prior_sg.deploy.sample import COARSE, SAMPLE
from prior_sg.deploy.settings import DEMO_ENVIRONMENT, DEMO_TASK
from prior_sg.services.runtime import heap


def add_commands(commands: Commands) -> None:
    """`demo` and `run`."""
    demo = commands.add(
        "demo",
        cmd_demo,
        "run everything on the sample home and score the result",
        "prior-sg demo --workers 2",
        needs="encode",
    )
    demo.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for the results")
    demo.add_argument("--task", default=DEMO_TASK, help="what the robot is to do (default: %(default)s)")
    demo.add_argument("--regions", default="", help="fixed region names, separated by commas; see --open")
    demo.add_argument(
        "--open",
        action="store_true",
        help="let the prior name the regions; by default the demo fixes the ground truth's names, as the paper's "
        "benchmarks do, so that labels can be scored",
    )
    demo.add_argument(
        "--fleet",
        action="store_true",
        help="instead of the sample: two robots in one generated house of several storeys, their maps merged live, on "
        "the page",
    )
    add_run_options(demo)
    add_log_mb(demo)

    run = commands.add(
        "run",
        cmd_run,
        "turn a recording, or what a robot sees, into a scene graph",
        'prior-sg run deploy/sample/home.mcap --environment "residential home" --task "serve drinks to guests"',
        needs="encode",
    )
    run.add_argument(
        "source",
        help="a folder in a known layout (docs/sources.md), a recording, ros2:/ for a robot, or realsense: or oak:",
    )
    run.add_argument("--environment", required=True, help="what kind of place it is, in plain words")
    run.add_argument("--task", required=True, help="what the robot is to do, in plain words")
    run.add_argument("--regions", default="", help="fixed region names, separated by commas; default: the prior's")
    run.add_argument("--out", type=Path, default=Path("out/run"), help="folder for the results")
    run.add_argument("--in-process", action="store_true", help="all services in this process, for debugging")
    add_run_options(run)
    add_log_mb(run)
    add_source_options(run)


def _at_least_one(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return number


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Options of whatever starts services."""
    add_bus(parser)
    parser.add_argument("--workers", type=_at_least_one, default=1, help="feature workers (default: %(default)s)")
    parser.add_argument(
        "--speed", type=float, default=0.0, help="replay speed; 0 = as fast as the pipeline drains (default)"
    )
    parser.add_argument(
        "--places",
        choices=("3d", "2d"),
        help="spheres of free space, or pieces of ground for large and unbounded spaces (default: 3d)",
    )
    parser.add_argument(
        "--encoder", default="", help="conse/…, open_clip/MODEL/PRETRAINED or onnx:FOLDER (docs/encoders.md)"
    )
    add_settings(parser)


def settings_of(arguments: argparse.Namespace) -> list[str]:
    """Settings that run options stand for, then those given by --set."""
    places = [f"place_graph.places={arguments.places}"] if arguments.places else []
    return [*places, *encoder_settings(arguments.encoder), *source_settings(arguments), *arguments.set]


def encoder_settings(choice: str) -> list[str]:
    """Settings of workers and segmenter for one choice of an encoder. Raises UsageError."""
    from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, space_of

    try:
        return [f"feature_pyramid.space={choice}", f"segmenter.space={space_of(choice)}"] if choice else []
    except EncoderUnavailable as error:
        raise UsageError(str(error)) from error


def cmd_demo(arguments: argparse.Namespace) -> int:
    """The main job on the embedded sample, or two robots' maps merged."""
    from prior_sg.deploy.truth import truth_of

    if arguments.fleet:
        from prior_sg.deploy.cli.fleet import show_fleet

        return show_fleet(arguments.out)
    arguments.source, arguments.environment = str(SAMPLE), DEMO_ENVIRONMENT
    if SAMPLE == COARSE:
        console.print("sample: the coarse one of the package; a checkout has the full one, which scores higher")
    if not (arguments.regions or arguments.open) and arguments.task == DEMO_TASK:
        truth = truth_of(arguments.source) or {"regions": []}
        arguments.regions = ",".join(dict.fromkeys(region["label"] for region in truth["regions"]))
        console.print(
            f"region names fixed to the ground truth's: {arguments.regions.replace(',', ', ')} (--open frees them)"
        )
    return cmd_run(arguments)


def cmd_run(arguments: argparse.Namespace) -> int:
    """The main job on a source of the user's."""
    from prior_sg.deploy.cli.mending import check_mapped
    from prior_sg.deploy.running.job import Job, run
    from prior_sg.services.ingest.core.options import is_live

    if not (is_live(arguments.source) or Path(arguments.source).exists()):
        raise UserError(f"{arguments.source} does not exist")
    beside = before_start(arguments.source, read_options(arguments), console, mapping_options(arguments)).beside
    heap.give_back()  # what the images that were looked at took
    job = Job(
        source=arguments.source,
        out=arguments.out,
        environment=arguments.environment,
        task=arguments.task,
        regions=names_in(arguments.regions),
        robot=arguments.robot,
        connect=arguments.connect,
        workers=arguments.workers,
        speed=arguments.speed,
        settings=settings_of(arguments),
        config=arguments.config,
        in_process=getattr(arguments, "in_process", False),
        log_mb=arguments.log_mb,
        on_started=lambda endpoint, pids: console.print(
            f"{len(pids)} service processes: " + ", ".join(f"{name} {pid}" for name, pid in sorted(pids.items()))
        ),
    )
    result = run(job, console)
    from prior_sg.deploy.cli import report  # what scores and draws takes as much memory as all else of this process

    report.write(result, job.out, beside.regions, console, beside.objects)
    if result.interrupted:
        counts = result.counts
        console.print(f"interrupted: {counts.not_encoded} of {len(counts.keyframes)} keyframes were not encoded")
        return EXIT_INTERRUPTED
    check_mapped(result, arguments.source)
    return 0
