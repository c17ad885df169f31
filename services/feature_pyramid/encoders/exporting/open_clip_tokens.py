"""open_clip's tokenizers as files of the package `tokenizers`.

What open_clip does to a text first (repairing its encoding, HTML entities) is taken over as far as phrases that people
write need it: quotes, white space, case, punctuation.
"""

import string
from typing import Any

from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, processors

from prior_sg.services.feature_pyramid.encoders.exporting.model import ExportError

WORDS = r"(?i)'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"  # CLIP's, of a text in lower case
PUNCTUATION = "[" + "".join(f"\\{character}" for character in string.punctuation) + "]"
CLEANING = ("whitespace", "lower", "canonicalize")


def tokenizer_of(tokenizer: Any, model: str) -> Tokenizer:
    """A tokenizer of open_clip's as one of the package. Raises ExportError for kinds without a counterpart."""
    kind, backend = type(tokenizer).__name__, getattr(getattr(tokenizer, "tokenizer", None), "backend_tokenizer", None)
    usual = not getattr(tokenizer, "reduction_fn", None) and not getattr(tokenizer, "tokenizer_mode", "")
    if kind == "SimpleTokenizer" and usual:
        return _of_clip(tokenizer)
    if kind == "HFTokenizer" and usual and backend is not None:
        copy = behind(cleaning(_way(tokenizer)), backend)
        if tokenizer.strip_sep_token:
            copy.post_processor = _blank_separator(tokenizer.tokenizer)
        return copy
    raise ExportError(f"the tokenizer of {model} ({kind}) cannot be written as a file; export another model.")


def behind(first: list[Any], tokenizer: Tokenizer) -> Tokenizer:
    """A copy of a tokenizer that normalises texts by `first` before its own way."""
    copy = Tokenizer.from_str(tokenizer.to_str())
    own = [] if copy.normalizer is None else [copy.normalizer]
    copy.normalizer = normalizers.Sequence([*first, *own])
    return copy


def cleaning(way: str) -> list[Any]:
    """What open_clip calls `whitespace`, `lower` and `canonicalize`."""
    steps: list[Any] = [
        normalizers.NFC(),
        normalizers.Replace(Regex("[\u02bc\u2018-\u201b]"), "'"),
        normalizers.Replace(Regex("[\u201c-\u201f]"), '"'),
    ]
    if way == "canonicalize":
        steps += [normalizers.Replace("_", " "), normalizers.Replace(Regex(PUNCTUATION), "")]
    if way != "whitespace":
        steps.append(normalizers.Lowercase())
    return [*steps, normalizers.Replace(Regex(r"\s+"), " "), normalizers.Strip()]


def _way(tokenizer: Any) -> str:
    """How a tokenizer cleans texts, by the name of the function."""
    return tokenizer.clean_fn.__name__.removeprefix("_clean_")


def _blank_separator(own: Any) -> processors.PostProcessor:
    """BERT's marks around a text, the second of them 0 as everything behind it."""
    return processors.TemplateProcessing(
        single=f"{own.cls_token} $A {own.sep_token}",
        special_tokens=[(own.cls_token, own.cls_token_id), (own.sep_token, 0)],
    )


def _of_clip(tokenizer: Any) -> Tokenizer:
    """CLIP's own byte-pair encoding."""
    start, end = "<start_of_text>", "<end_of_text>"
    copy = Tokenizer(
        models.BPE(
            vocab=tokenizer.encoder,
            merges=list(tokenizer.bpe_ranks),
            continuing_subword_prefix="",
            end_of_word_suffix="</w>",
            fuse_unk=False,
        )
    )
    copy.normalizer = normalizers.Sequence(cleaning(_way(tokenizer)))
    copy.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(WORDS), behavior="removed", invert=True),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    copy.post_processor = processors.TemplateProcessing(
        single=f"{start} $A {end}",
        special_tokens=[(start, tokenizer.sot_token_id), (end, tokenizer.eot_token_id)],
    )
    return copy
