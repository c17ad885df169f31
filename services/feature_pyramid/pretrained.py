"""Networks with their published weights, through transformers."""

from typing import Any

from prior_sg.services.feature_pyramid.encoders import torchvision_parts
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, package


def torch() -> Any:
    """PyTorch. Raises EncoderUnavailable where it is not installed."""
    return package("torch")


def load(what: str, kind: str, model: str, device: str) -> tuple[Any, Any, str]:
    """Processor and network of a class of transformers from a folder or a published name, and the device it is on.

    `what` names it in the error. Raises EncoderUnavailable.
    """
    cuda = device == "cuda" or (device == "auto" and torch().cuda.is_available())
    torchvision_parts.load_if_installed()
    transformers = package("transformers")
    transformers.utils.logging.disable_progress_bar()
    try:
        processor = transformers.AutoProcessor.from_pretrained(model)
        network = getattr(transformers, kind).from_pretrained(model).eval()
    except (OSError, ValueError) as error:
        raise EncoderUnavailable(
            f"the weights of {what} cannot be loaded ({str(error).splitlines()[0]}); name a folder that holds them or "
            "a model that this machine can download."
        ) from error
    where = "cuda" if cuda else "cpu"
    return processor, network.to(where), where
