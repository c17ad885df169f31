"""`prior-sg encoders`: write a published model as a folder, and try an encoder."""

import argparse
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from prior_sg.deploy.cli.shared import Commands, console
from prior_sg.deploy.errors import UserError

MB = 1e6
TRIED_CROPS = 64


def add_commands(commands: Commands) -> None:
    """`encoders` and its actions."""
    parser = commands.add(
        "encoders",
        _run,
        "write a published model as a folder of its own, or try an encoder",
        "prior-sg encoders check conse/efficientnet-lite0/minilm-l6-v2",
        "encode",
    )
    actions = Commands(parser, "action", "ACTION", "prior-sg encoders ")
    export = actions.add(
        "export",
        _run,
        "write a model of open_clip, or SigLIP through transformers, as the folder of the encoder onnx:FOLDER, and "
        "compare it with PyTorch",
        "export open_clip/ViT-B-16/datacomp_xl_s13b_b90k --out models/vit-b-16",
        "encode",
    )
    export.add_argument("choice", help="open_clip/MODEL/PRETRAINED, open_clip/MODEL/FILE or siglip/HF_NAME")
    export.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="the folder to write")
    export.add_argument("--licence", default="", help="of the weights, for the manifest")
    check = actions.add(
        "check",
        _run,
        "load an encoder and say its space and how fast it is",
        "check onnx:models/vit-b-16",
        "encode",
    )
    check.add_argument("choice", help="conse/…, open_clip/MODEL/PRETRAINED or onnx:FOLDER (docs/encoders.md)")
    check.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="(default: %(default)s)")


def cmd_export(arguments: argparse.Namespace) -> int:
    """Write the folder with progress, and say how far it is from PyTorch. Raises ServiceError."""
    from prior_sg.services.feature_pyramid.encoders.exporting.folder import TOLERANCE, export

    with _quiet(), console.status("starting") as status:
        found = export(arguments.choice, arguments.out, arguments.licence, status.update)
    size = f"{found.size_bytes / MB:.0f} MB, {found.dim} numbers per embedding, crops of {found.side_px} px"
    console.print(f"{arguments.out}: {size}", soft_wrap=True)
    distances = f"images {found.image_distance:.1e}, texts {found.text_distance:.1e}"
    console.print(f"distance from PyTorch's unit embeddings, at most: {distances} (allowed: {TOLERANCE:.0e})")
    console.print(f"space {found.space}; use it with --encoder onnx:{arguments.out}", soft_wrap=True)
    return 0


def cmd_check(arguments: argparse.Namespace) -> int:
    """Load an encoder, time it, and compare a phrase with itself. Raises UserError, ServiceError."""
    from prior_sg.services.feature_pyramid.encoders.base import Options, load_encoder
    from prior_sg.services.feature_pyramid.encoders.two_towers import pictures_of_nothing

    with _quiet(), console.status(f"loading {arguments.choice}"):
        encoder = load_encoder(arguments.choice, Options(device=arguments.device))
        crops = pictures_of_nothing()
        crops = (crops * (TRIED_CROPS // len(crops) + 1))[:TRIED_CROPS]
        encoder.encode_images(crops[: encoder.batch_size])  # the first batch is slower
        start_s = time.perf_counter()
        encoder.encode_images(crops)
        rate = TRIED_CROPS / (time.perf_counter() - start_s)
    text = encoder.encode_text([["a kitchen"]])
    if not text.background_std[0] > 0:
        raise UserError(f"{arguments.choice} sees no difference between pictures; its weights are broken, use others")
    console.print(f"space {encoder.space}: {encoder.dim} numbers, crops of {encoder.side_px} px", soft_wrap=True)
    console.print(f"{rate:.1f} crops per second, {encoder.batch_size} at a time")
    return 0


ACTIONS = {"export": cmd_export, "check": cmd_check}


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what the libraries log: of a failure, our sentence tells the reason."""
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


def _run(arguments: argparse.Namespace) -> int:
    return ACTIONS[arguments.action](arguments)
