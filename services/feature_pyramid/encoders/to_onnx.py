"""Networks of PyTorch as ONNX files."""

import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from prior_sg.services.feature_pyramid.encoders.base import package

OPSET = 17
MOST_BYTES = 1_900_000_000  # of weights beside the graph: a file of ONNX holds less than 2 GiB


def write(network: Any, example: tuple, path: Path, inputs: dict[str, dict[int, str]], output: str) -> None:
    """Write a network as one file; `inputs` are its arguments with their free axes, by name."""
    package("onnx")  # which the exporter needs
    with warnings.catch_warnings(), _plain_attention():
        warnings.simplefilter("ignore")  # the tracing exporter works from torch 2.2 on; its successor needs far more
        torch.onnx.export(
            network,
            example,
            str(path),
            input_names=list(inputs),
            output_names=[output],
            dynamic_axes={**inputs, output: {0: "row"}},
            opset_version=OPSET,
            dynamo=False,
        )


def write_large(
    network: Any,
    example: tuple,
    path: Path,
    inputs: dict[str, dict[int, str]],
    output: str,
    *,
    apart: bool = False,
) -> Path | None:
    """As `write`, but weights that are too many for one file, or are to lie `apart`, go into a second one beside it,
    which is returned."""
    if not apart and sum(value.numel() * value.element_size() for value in network.state_dict().values()) <= MOST_BYTES:
        write(network, example, path, inputs, output)
        return None
    onnx, weights = package("onnx"), path.with_suffix(".weights")
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:  # the exporter writes a file per weight
        write(network, example, Path(folder) / path.name, inputs, output)
        onnx.save_model(
            onnx.load(str(Path(folder) / path.name)),
            str(path),
            save_as_external_data=True,
            all_tensors_to_one_file=True,
            location=weights.name,
        )
    weights.chmod(path.stat().st_mode)  # the library lets nobody else read it
    return weights


@contextmanager
def _plain_attention() -> Iterator[None]:
    """Attention of operators that ONNX has: PyTorch takes one of its own for inference."""
    before = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        yield
    finally:
        torch.backends.mha.set_fastpath_enabled(before)
