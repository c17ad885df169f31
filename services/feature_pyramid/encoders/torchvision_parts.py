"""Lets torchvision's Python parts load where its compiled operators do not fit the installed PyTorch.

open_clip imports torchvision for transforms written in Python, and transformers imports it wherever it is installed.
Wheels of torchvision for graphics cards do not load beside a PyTorch for processors: they fail when they describe
operators that their library did not bring. We name those operators, so the description succeeds; whoever calls one gets
PyTorch's error that it has no implementation.
"""

import importlib
import importlib.util
import re
import sys
from typing import Any

MISSING = re.compile(r"operator torchvision::(\w+) does not exist")
MOST = 50  # operators; torchvision has about a dozen

_named: list[Any] = []  # libraries live as long as the process


def load() -> Any:
    """The package torchvision, its Python parts at least. Raises ImportError when it is not installed."""
    for _ in range(MOST):
        try:
            return importlib.import_module("torchvision")
        except RuntimeError as error:
            missing = MISSING.search(str(error))
            if missing is None:
                raise
            _name(missing.group(1))
    raise RuntimeError("torchvision does not load")


def load_if_installed() -> None:
    """For packages that import torchvision when it is there; to be called before them."""
    if importlib.util.find_spec("torchvision") is not None:
        load()


def _name(operator: str) -> None:
    import torch

    library = torch.library.Library("torchvision", "FRAGMENT")
    library.define(f"{operator}(Tensor unused) -> Tensor")
    _named.append(library)
    for module in [name for name in sys.modules if name == "torchvision" or name.startswith("torchvision.")]:
        del sys.modules[module]
