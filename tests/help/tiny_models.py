"""Models with an image and a text tower, tiny, with random weights: for mechanics, not for accuracy."""

import json

import torch

from prior_sg.services.feature_pyramid.encoders import torchvision_parts

WORDS = (
    "a picture of a kitchen", "the inside of a railway station with many people", "children play area",
    "a photo of the living room and hall", "blurry empty image texture noise nothing", "caf\u00e9 k\u00fcche dog open",
)  # fmt: skip
CONTEXT = 16
SIDE_PX = 32


def open_clip_choice(folder, name="tiny-export", **text):
    """A model of open_clip's with its weights in a file; `text` changes its text tower."""
    torchvision_parts.load()
    import open_clip

    about = {
        "embed_dim": 32,
        "vision_cfg": {"image_size": SIDE_PX, "layers": 2, "width": 64, "head_width": 32, "patch_size": 8},
        "text_cfg": {"context_length": CONTEXT, "vocab_size": 49408, "width": 64, "heads": 2, "layers": 2, **text},
    }
    (folder / f"{name}.json").write_text(json.dumps(about))
    open_clip.add_model_config(folder / f"{name}.json")
    torch.manual_seed(0)
    torch.save(open_clip.create_model(name).state_dict(), folder / f"{name}.pt")
    return f"open_clip/{name}/{folder / name}.pt"


def siglip_folder(folder):
    """SigLIP with a picture's and no text's way in."""
    torchvision_parts.load_if_installed()
    import transformers

    common = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = {**common, "vocab_size": 600, "max_position_embeddings": CONTEXT}
    vision = {**common, "image_size": SIDE_PX, "patch_size": 8}
    torch.manual_seed(0)
    transformers.SiglipModel(transformers.SiglipConfig(text_config=text, vision_config=vision)).save_pretrained(folder)
    transformers.SiglipImageProcessor(size={"height": SIDE_PX, "width": SIDE_PX}).save_pretrained(folder)
    return folder


def byte_pairs(folder):
    """A tokenizer of byte pairs, which knows case."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors, trainers
    from transformers import PreTrainedTokenizerFast

    found = Tokenizer(models.BPE(unk_token="<unk>"))
    found.pre_tokenizer = pre_tokenizers.Metaspace()
    specials = ["<pad>", "<eos>", "<unk>"]
    found.train_from_iterator(WORDS, trainers.BpeTrainer(vocab_size=500, special_tokens=specials, show_progress=False))
    found.post_processor = processors.TemplateProcessing(single="$A <eos>", special_tokens=[("<eos>", 1)])
    names = {"pad_token": "<pad>", "eos_token": "<eos>", "unk_token": "<unk>"}
    PreTrainedTokenizerFast(tokenizer_object=found, padding_side="right", **names).save_pretrained(folder)
    return folder


def word_pieces(folder):
    """A tokenizer of whole words with BERT's marks around a text."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    words = sorted({word for text in WORDS for word in text.split()})
    vocabulary = {word: number for number, word in enumerate(["[PAD]", "[UNK]", "[CLS]", "[SEP]", *words])}
    found = Tokenizer(models.WordLevel(vocabulary, unk_token="[UNK]"))
    found.pre_tokenizer = pre_tokenizers.Whitespace()
    marks = [("[CLS]", 2), ("[SEP]", 3)]
    found.post_processor = processors.TemplateProcessing(single="[CLS] $A [SEP]", special_tokens=marks)
    names = {"pad_token": "[PAD]", "unk_token": "[UNK]", "cls_token": "[CLS]", "sep_token": "[SEP]"}
    PreTrainedTokenizerFast(tokenizer_object=found, padding_side="right", **names).save_pretrained(folder)
    return folder


def sentence_pieces(folder):
    """The first SigLIP's own tokenizer, learned from WORDS."""
    import sentencepiece
    from transformers import SiglipTokenizer

    (folder / "texts").write_text("\n".join(20 * WORDS))
    sentencepiece.SentencePieceTrainer.train(
        input=str(folder / "texts"), model_prefix=str(folder / "spiece"), vocab_size=120, hard_vocab_limit=False,
        pad_id=0, eos_id=1, unk_id=2, bos_id=-1, minloglevel=2,
    )  # fmt: skip
    SiglipTokenizer(str(folder / "spiece.model")).save_pretrained(folder)
    return folder
