"""Encoders with two towers, open_clip's and a user's export. Tiny models, random weights: mechanics, no accuracy."""

import hashlib
import json

import numpy as np
import pytest
import torch
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import Whitespace

from prior_sg.services.feature_pyramid.encoders import two_towers
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, Options, load_encoder, space_of

CONFIG = {
    "embed_dim": 32,
    "vision_cfg": {"image_size": 32, "layers": 2, "width": 64, "head_width": 32, "patch_size": 8},
    "text_cfg": {"context_length": 16, "vocab_size": 49408, "width": 64, "heads": 2, "layers": 2},
}
RNG = np.random.default_rng(3)
CROPS = [RNG.integers(0, 256, (side, side, 3), dtype=np.uint8) for side in (32, 32, 80, 20, 80)]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A model of open_clip's with random weights, in a file."""
    from prior_sg.services.feature_pyramid.encoders import torchvision_parts

    torchvision_parts.load()
    import open_clip

    folder = tmp_path_factory.mktemp("models")
    (folder / "tiny-test.json").write_text(json.dumps(CONFIG))
    open_clip.add_model_config(folder / "tiny-test.json")
    torch.manual_seed(0)
    model = open_clip.create_model("tiny-test").eval()
    torch.save(model.state_dict(), folder / "weights one.pt")
    return model, f"open_clip/tiny-test/{folder}/weights one.pt"


def test_open_clip_equals_its_own_use(tiny):
    """Images at the network's side and texts, against open_clip called by hand."""
    import open_clip

    model, choice = tiny
    encoder = load_encoder(choice, Options(batch_size=2, device="cpu"))
    assert encoder.space == space_of(choice) == "open_clip/tiny-test/weights-one"
    assert (encoder.dim, encoder.side_px) == (32, 32)
    found = encoder.encode_images(CROPS)
    assert found.shape == (5, 32) and np.linalg.norm(found, axis=1) == pytest.approx(np.ones(5), abs=1e-5)
    preprocess = open_clip.image_transform(32, is_train=False, mean=model.visual.image_mean, std=model.visual.image_std)
    from PIL import Image

    with torch.inference_mode():
        for crop, ours in zip(CROPS, found, strict=True):
            theirs = model.encode_image(preprocess(Image.fromarray(crop))[None])[0]
            theirs = (theirs / theirs.norm()).numpy()
            assert ours @ theirs > (0.99999 if len(crop) == 32 else 0.99)  # they round resized pixels to integers
        tokens = open_clip.get_tokenizer("tiny-test")([t.format("a dog") for t in two_towers.TEMPLATES])
        texts = model.encode_text(tokens)
        texts = (texts / texts.norm(dim=1, keepdim=True)).mean(dim=0)
    text = encoder.encode_text([["a dog"], ["a cat", "a kitten"]])
    assert text.embeddings[0] == pytest.approx((texts / texts.norm()).numpy(), abs=1e-5)
    assert encoder.encode_images([]).shape == (0, 32)


def test_calibration_is_the_models_own_logit_less_each_concepts_bias(tiny):
    encoder = load_encoder(tiny[1], Options(device="cpu"))
    text = encoder.encode_text([["a dog"], ["a kitchen"], ["a corridor"]])
    images = encoder.encode_images(CROPS)
    background = encoder.encode_images(two_towers.pictures_of_nothing())
    similarity, bias = images @ text.embeddings.T, (background @ text.embeddings.T).mean(axis=0)
    logits = text.temperature * (similarity - text.background_mean) / text.background_std
    scale = float(tiny[0].logit_scale.exp())
    assert logits == pytest.approx(scale * (similarity - bias), abs=1e-3)
    assert text.null_score >= 0 and (text.background_std > 0).all()
    with pytest.raises(ValueError, match="no phrases"):
        encoder.encode_text([[]])


def test_a_text_is_embedded_once(tiny, monkeypatch):
    """Priors of one environment repeat their phrases; what was asked before costs nothing, and gives the same."""
    encoder, seen = load_encoder(tiny[1], Options(device="cpu")), []
    embed = encoder._texts
    monkeypatch.setattr(encoder, "_texts", lambda texts: seen.append(len(texts)) or embed(texts))
    first = encoder.encode_text([["a dog", "a cat"], ["a dog"]]).embeddings
    again = encoder.encode_text([["a dog"], ["a hall"], ["a cat", "a dog"]]).embeddings
    assert seen == [2 * 3, 3]
    assert again[0] == pytest.approx(first[1], abs=1e-6) and again[2] == pytest.approx(first[0], abs=1e-6)
    monkeypatch.setattr(two_towers, "KNOWN_TEXTS", 4)
    assert encoder.encode_text([["a dog"]]).embeddings[0] == pytest.approx(first[1], abs=1e-6)
    assert seen == [6, 3] and len(encoder._known) == 9
    encoder.encode_text([["a wall"]])
    assert seen == [6, 3, 3] and len(encoder._known) == 3


def test_pictures_of_nothing_are_always_the_same():
    first, again = two_towers.pictures_of_nothing(), two_towers.pictures_of_nothing()
    assert all((one == other).all() for one, other in zip(first, again, strict=True))
    assert len({picture.tobytes() for picture in first}) == two_towers.PICTURES_OF_NOTHING


@pytest.mark.parametrize(
    ("choice", "says"),
    [
        ("open_clip/ViT-B-32", "write open_clip/MODEL/PRETRAINED"),
        ("open_clip/ViT-Z-99/openai", "no model 'ViT-Z-99'"),
        ("open_clip/ViT-B-32/laion9b", "no weights 'laion9b' for ViT-B-32; choose from openai"),
        ("open_clip/ViT-B-32//nowhere/weights.pt", "weight file /nowhere/weights.pt does not exist"),
        ("onnx:/nowhere", "/nowhere has no manifest.json"),
    ],
)
def test_wrong_choices_are_told_in_one_sentence(choice, says):
    with pytest.raises(EncoderUnavailable, match=says) as failure:
        load_encoder(choice, Options(device="cpu"))
    assert "\n" not in str(failure.value) and str(failure.value).endswith(".")


def test_a_broken_weight_file_is_told_in_one_sentence(tiny, tmp_path):
    (tmp_path / "bad.pt").write_bytes(b"not weights")
    with pytest.raises(EncoderUnavailable, match="cannot be loaded") as failure:
        load_encoder(f"open_clip/tiny-test/{tmp_path}/bad.pt", Options(device="cpu"))
    assert "\n" not in str(failure.value)


@pytest.mark.usefixtures("tiny")
def test_the_measurement_for_graphics_cards_on_a_processor():
    """Mechanics only: operations of one picture by hand, and every figure there."""
    import open_clip

    from prior_sg.deploy.benches import graphics

    model = open_clip.create_model("tiny-test").eval()
    tokens, width = 17, 64
    block = 2 * tokens * (4 * width * width + 2 * width * 4 * width)  # projections and the two layers behind them
    least = 2 * block + 2 * 16 * width * 3 * 64  # two blocks, and the patches; attention itself comes on top
    counted = graphics.flops(model, torch.zeros(1, 3, 32, 32))
    assert least <= counted <= 1.3 * least
    found = graphics.measured("tiny-test", "cpu", 6, peak=1e12)
    assert set(found) == {"crops_per_s", "peak_share", "openclip_ratio", "encode_image_ratio"}
    assert all(value > 0 for value in found.values())
    assert found["peak_share"] == pytest.approx(found["crops_per_s"] * counted / 1e12)


class ImageNet(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.conv = torch.nn.Conv2d(3, 8, 8, 8)

    def forward(self, pixels):
        return self.conv(pixels).flatten(2).tanh().mean(dim=2)


class TextNet(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.words = torch.nn.Embedding(16, 8)

    def forward(self, tokens):
        return self.words(tokens).mean(dim=1)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    torch.manual_seed(1)
    image, text = ImageNet().eval(), TextNet().eval()
    common = {"dynamo": False, "opset_version": 17}
    torch.onnx.export(
        image, (torch.zeros(2, 3, 32, 32),), str(folder / "image.onnx"), input_names=["pixels"],
        dynamic_axes={"pixels": {0: "n"}}, **common,
    )  # fmt: skip
    torch.onnx.export(
        text, (torch.zeros(2, 6, dtype=torch.int64),), str(folder / "text.onnx"), input_names=["tokens"],
        dynamic_axes={"tokens": {0: "n"}}, **common,
    )  # fmt: skip
    words = {word: number for number, word in enumerate(["[PAD]", "[UNK]", "a", "picture", "photo", "of", "dog"])}
    tokenizer = Tokenizer(WordLevel(words, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = Whitespace()
    tokenizer.save(str(folder / "tokenizer.json"))
    sha256 = {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in folder.iterdir()}
    manifest = {
        "name": "toy clip",
        "image": {"file": "image.onnx", "side_px": 32, "mean": [0.5, 0.4, 0.3], "std": [0.2, 0.3, 0.25]},
        "text": {"file": "text.onnx", "context": 6},
        "tokenizer": {"file": "tokenizer.json"},
        "logit_scale": 50.0,
    }
    for part in ("image", "text", "tokenizer"):
        manifest[part]["sha256"] = sha256[manifest[part]["file"]]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder, image, text


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_users_export(exported):
    folder, image, text = exported
    encoder = load_encoder(f"onnx:{folder}", Options(threads=1, batch_size=2))
    assert encoder.space == space_of(f"onnx:{folder}") and encoder.space.startswith("onnx/toy-clip-")
    found = encoder.encode_images(CROPS[:2])
    with torch.inference_mode():
        pixels = (torch.tensor(np.stack(CROPS[:2])).float() / 255 - torch.tensor([0.5, 0.4, 0.3])) / torch.tensor(
            [0.2, 0.3, 0.25]
        )
        expected = image(pixels.permute(0, 3, 1, 2)).numpy()
        words = text(torch.tensor([[2, 6, 0, 0, 0, 0], [2, 3, 5, 2, 6, 0], [2, 4, 5, 2, 6, 0]])).numpy()
    assert found == pytest.approx(expected / np.linalg.norm(expected, axis=1, keepdims=True), abs=1e-5)
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    concept = encoder.encode_text([["a dog"]]).embeddings[0]
    assert concept == pytest.approx(words.mean(axis=0) / np.linalg.norm(words.mean(axis=0)), abs=1e-5)


def test_an_export_that_is_not_what_its_manifest_says(exported, tmp_path):
    folder = exported[0]
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    choice = f"onnx:{tmp_path}"
    (tmp_path / "text.onnx").write_bytes(b"other")
    with pytest.raises(EncoderUnavailable, match=r"text\.onnx is not the file that manifest\.json describes"):
        load_encoder(choice, Options())
    (tmp_path / "text.onnx").unlink()
    with pytest.raises(EncoderUnavailable, match=r"text\.onnx is missing"):
        load_encoder(choice, Options())
    (tmp_path / "manifest.json").write_text('{"name": "x"}')
    with pytest.raises(EncoderUnavailable, match=r"manifest\.json is not valid: .*image"):
        load_encoder(choice, Options())
