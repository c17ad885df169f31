"""Prompts: readable text files, one folder per version; `$name` stands for what the conversation fills in."""

import hashlib
from importlib.resources import files
from pathlib import Path
from string import Template

from prior_sg.services.folders import expanded
from prior_sg.services.prior_gateway.core.turns import PROMPT_FIELDS, Prompts
from prior_sg.services.runtime.service import ServiceError


def load(version: str) -> Prompts:
    """The prompts of a shipped version, or of a folder of the user's. Raises ServiceError that names the file."""
    own = expanded(version)
    shipped = files(__package__) / "prompts" / version
    folder = own if own.is_dir() else shipped
    texts: dict[str, Template] = {}
    content = hashlib.blake2b(digest_size=4)
    for name, fields in sorted(PROMPT_FIELDS.items()):
        file = folder / f"{name}.txt"
        try:
            text = file.read_text(encoding="utf-8")
        except OSError as error:
            raise ServiceError(
                f"prior_gateway.prompts: {file} cannot be read; name a shipped version (v1) or a folder with "
                f"{', '.join(f'{known}.txt' for known in sorted(PROMPT_FIELDS))}"
            ) from error
        template = Template(text.strip())
        if not template.is_valid() or not set(template.get_identifiers()) <= fields:
            known = ", ".join(f"${field}" for field in sorted(fields)) or "no fields"
            raise ServiceError(f"prior_gateway.prompts: {file} may use {known} (write $$ for a dollar sign)")
        texts[name] = template
        content.update(template.template.encode())
    return Prompts(version=f"{Path(version).name}-{content.hexdigest()}", texts=texts)
