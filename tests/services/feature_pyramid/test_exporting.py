"""Published models as folders: what is read back equals PyTorch, alone and through a worker. Random weights."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from prior_sg.deploy.cli.main import main
from prior_sg.schemas.features import TextRequest
from prior_sg.services.feature_pyramid import service
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.encoders import onnx, open_clip, to_onnx
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, Options, load_encoder
from prior_sg.services.feature_pyramid.encoders.exporting import folder as exporting
from prior_sg.services.feature_pyramid.encoders.exporting.model import ExportError
from prior_sg.services.feature_pyramid.encoders.resampling import resampled
from prior_sg.services.runtime.service import Identity
from tests.help import tiny_models
from tests.services.feature_pyramid.test_feature_pyramid import checkered, keyframe

PHRASES = [
    "kitchen", "A Café, open 24/7", "children's play_area", "it’s a “hall”", "  two   spaces ", "Küche & Bad",
    "don't, can't; we'll!", "日本 の 部屋", "3D-printer room no. 12", "long corridor " * 20, "",
]  # fmt: skip


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A model of open_clip's, and what became of it."""
    folder = tmp_path_factory.mktemp("tiny")
    choice, said = tiny_models.open_clip_choice(folder), []
    return choice, folder / "out", exporting.export(choice, folder / "out", "CC0", said.append), said


@pytest.mark.parametrize("way", ["bicubic", "bilinear"])
@pytest.mark.parametrize(("source", "target"), [(480, 224), (100, 224), (224, 224), (33, 32), (500, 7), (17, 40)])
def test_crops_are_resized_as_in_torchvision(source, target, way, rng):
    crop = rng.integers(0, 256, (source, source, 3), dtype=np.uint8)
    raw = torch.from_numpy(crop).permute(2, 0, 1)[None].float()
    theirs = torch.nn.functional.interpolate(raw, (target, target), mode=way, align_corners=False, antialias=True)
    assert resampled(crop, target, way) == pytest.approx(theirs.clamp(0, 255)[0].numpy(), abs=0.02)


def test_a_flat_crop_stays_flat_and_a_step_keeps_its_place():
    assert resampled(np.full((50, 50, 3), 77, np.uint8), 32, "bicubic") == pytest.approx(77.0, abs=1e-3)
    step = np.zeros((40, 40, 3), np.uint8)
    step[:, 20:] = 200
    assert resampled(step, 20, "bilinear")[0, 0, [0, 8, 11, 19]] == pytest.approx([0, 0, 200, 200])


def test_what_is_written_equals_pytorch_called_by_hand(tiny):
    choice, folder, found, said = tiny
    assert max(found.image_distance, found.text_distance) < 1e-5 and len(said) == 5
    encoder = load_encoder(f"onnx:{folder}", Options(batch_size=3))
    assert (encoder.space, encoder.dim, encoder.side_px) == (found.space, 32, 32)
    torch_towers = open_clip.towers_of(choice, Options(device="cpu"))
    model, tokens = torch_towers.model, torch_towers.tokenizer
    from PIL import Image

    visual = model.visual
    transform = open_clip.library().image_transform(32, is_train=False, mean=visual.image_mean, std=visual.image_std)
    crops = [np.random.default_rng(seed).integers(0, 256, (32, 32, 3), dtype=np.uint8) for seed in range(4)]
    with torch.inference_mode():
        images = model.encode_image(torch.stack([transform(Image.fromarray(crop)) for crop in crops]), normalize=True)
        texts = model.encode_text(tokens(["a Café", "a picture of a Café", "a photo of a Café"]), True)
    assert encoder.encode_images(crops) == pytest.approx(images.numpy(), abs=1e-5)
    mean = texts.mean(dim=0)
    assert encoder.encode_text([["a Café"]]).embeddings[0] == pytest.approx((mean / mean.norm()).numpy(), abs=1e-5)


def test_tokens_are_open_clips_own(tiny):
    choice, folder, *_ = tiny
    theirs = open_clip.towers_of(choice, Options(device="cpu")).tokenizer
    manifest = json.loads((folder / "manifest.json").read_text())
    ours = onnx.tokenizer_of(folder / "tokenizer.json", onnx.Text(**manifest["text"]))
    for phrase in PHRASES:
        assert ours.encode(phrase).ids == theirs([phrase])[0].tolist(), phrase


def test_the_manifest_says_where_the_weights_come_from(tiny):
    manifest = json.loads((tiny[1] / "manifest.json").read_text())
    assert manifest["source"] == "open_clip tiny-export, weights of the file tiny-export.pt"
    assert manifest["licence"] == "CC0" and manifest["image"]["interpolation"] == "bicubic"
    assert {"torch", "onnx", "open-clip-torch"} < set(manifest["made_with"])
    assert sorted(file.name for file in tiny[1].iterdir()) == [
        "image.onnx", "manifest.json", "text.onnx", "tokenizer.json",
    ]  # fmt: skip


def test_a_keyframe_and_a_question_through_the_worker(tiny):
    """Pyramid and text of the folder, beside those of a worker that runs the model in PyTorch."""
    choice, folder, *_ = tiny
    color, depth = checkered(), np.full((480, 640), 2500, np.uint16)
    answers = []
    for space in (choice, f"onnx:{folder}"):
        cfg = Config(space=space, device="cpu", threads=1)
        worker = service.init(cfg, Identity("*", "worker-1", 1))
        (_, pyramid), _ = service.step(worker, keyframe(color, depth), cfg)
        request = TextRequest(space=worker.encoder.space, concepts=[["a kitchen", "a galley"], ["a hall"]])
        answers.append((pyramid, service.answer_text(worker, request, cfg)))
        service.SERVICE.close(worker)
    (theirs, their_text), (ours, our_text) = answers
    assert ours.space != theirs.space and len(ours.embeddings) == len(theirs.embeddings) > 5
    assert ours.embeddings.astype(np.float32) == pytest.approx(theirs.embeddings.astype(np.float32), abs=2e-3)
    assert our_text.embeddings == pytest.approx(their_text.embeddings, abs=1e-5)
    assert our_text.background_mean == pytest.approx(their_text.background_mean, abs=1e-5)
    assert our_text.temperature == pytest.approx(their_text.temperature, rel=1e-3)
    assert our_text.null_score == pytest.approx(their_text.null_score, abs=1e-2)


ALONE = """
import sys
for module in ("torch", "torchvision", "open_clip", "transformers", "onnx", "PIL", "huggingface_hub"):
    sys.modules[module] = None
from prior_sg.services.feature_pyramid.encoders.base import Options, load_encoder
print(load_encoder(sys.argv[1], Options()).encode_text([["a kitchen"]]).embeddings[0].tolist())
"""


def test_the_folder_needs_nothing_that_made_it(tiny):
    done = subprocess.run(
        [sys.executable, "-c", ALONE, f"onnx:{tiny[1]}"], capture_output=True, text=True, timeout=60, check=True
    )
    here = load_encoder(f"onnx:{tiny[1]}", Options()).encode_text([["a kitchen"]]).embeddings[0]
    assert json.loads(done.stdout) == pytest.approx(here.tolist(), abs=1e-6)


@pytest.mark.parametrize(
    "about",
    [{"clean": "canonicalize"}, {"clean": "lower", "strip_sep_token": True}, {"strip_sep_token": True}],
    ids=["canonicalize", "lower", "without-separator"],
)
def test_other_tokenizers_of_open_clip(about, tmp_path):
    """Of transformers, behind what open_clip does to texts, and without the separator where open_clip blanks it."""
    pytest.importorskip("transformers")
    folder = tmp_path / "tokens"
    tokens = tiny_models.word_pieces if "strip_sep_token" in about else tiny_models.byte_pairs
    name = {"hf_tokenizer_name": str(tokens(folder)), "tokenizer_kwargs": about}
    choice = tiny_models.open_clip_choice(tmp_path, f"tiny-{len(about)}-{about.get('clean', 'plain')}", **name)
    found = exporting.export(choice, tmp_path / "out")
    assert found.text_distance < 1e-5
    theirs, ours = load_encoder(choice, Options(device="cpu")), load_encoder(f"onnx:{tmp_path / 'out'}", Options())
    for phrase in PHRASES[:-1]:
        there, here = (encoder.encode_text([[phrase]]).embeddings[0] for encoder in (theirs, ours))
        assert here == pytest.approx(there, abs=1e-5), phrase


def test_weights_that_fit_no_single_file(tmp_path, monkeypatch):
    monkeypatch.setattr(to_onnx, "MOST_BYTES", 0)
    found = exporting.export(tiny_models.open_clip_choice(tmp_path, "tiny-large"), tmp_path / "out")
    assert max(found.image_distance, found.text_distance) < 1e-5
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "image.onnx", "image.weights", "text.onnx", "text.weights", "tokenizer.json", "manifest.json",
    }  # fmt: skip
    modes = {file.stat().st_mode for file in (tmp_path / "out").iterdir()}
    assert len(modes) == 1
    (tmp_path / "out" / "text.weights").write_bytes(b"other")
    with pytest.raises(EncoderUnavailable, match=r"text\.weights is not the file that manifest\.json describes"):
        load_encoder(f"onnx:{tmp_path / 'out'}", Options())


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("tolerance", "the image network of tiny-export-tiny-export gives embeddings .* from PyTorch's, more than"),
        ("tokens", "the written tokenizer of tiny-export-tiny-export reads 'a kitchen' otherwise than its own"),
        ("exporter", "PyTorch cannot write image.onnx of this model"),
        ("interrupt", None),
    ],
)
def test_a_failure_leaves_nothing_behind(what, says, tiny, tmp_path, monkeypatch):
    def fail(*_):
        raise KeyboardInterrupt if what == "interrupt" else RuntimeError("unsupported operator.\nTraceback")

    if what == "tolerance":
        monkeypatch.setattr(exporting, "TOLERANCE", -1.0)
    elif what == "tokens":
        monkeypatch.setattr(onnx, "tokenizer_of", lambda *_: type("T", (), {"encode": lambda *_: _Ids()})())
    else:
        monkeypatch.setattr(to_onnx, "write_large", fail)
    with pytest.raises(KeyboardInterrupt if what == "interrupt" else ExportError, match=says) as failure:
        exporting.export(tiny[0], tmp_path / "out")
    assert list(tmp_path.iterdir()) == [] and "\n" not in str(failure.value)


class _Ids:
    ids = (1, 2, 3)


def test_a_folder_with_something_in_it_is_left_alone(tiny, tmp_path):
    (tmp_path / "out").mkdir()
    exporting.export(tiny[0], tmp_path / "out")
    with pytest.raises(ExportError, match="is there already; name a new folder with --out, or remove it"):
        exporting.export(tiny[0], tmp_path / "out")


def test_activations_are_those_that_the_weights_were_trained_with(monkeypatch, tmp_path):
    """Weights of OpenAI's want another one than the model's name says."""
    asked = {}

    def create(name, **about):
        asked.update(about)
        raise OSError("no network here. Try again")

    monkeypatch.setattr(open_clip.library(), "create_model", create)
    with pytest.raises(EncoderUnavailable, match=r"cannot be loaded \(no network here\); fetch them once"):
        exporting.export("open_clip/ViT-B-32/openai", tmp_path / "out")
    assert asked["force_quick_gelu"] is True
    with pytest.raises(EncoderUnavailable):
        load_encoder("open_clip/ViT-B-32/laion2b_e16", Options(device="cpu"))
    assert asked["force_quick_gelu"] is False


def test_siglip_of_transformers(tmp_path, rng):
    transformers = pytest.importorskip("transformers")
    source = tiny_models.byte_pairs(tiny_models.siglip_folder(tmp_path / "tiny-siglip"))
    found = exporting.export(f"siglip/{source}", tmp_path / "out")
    assert found.space.startswith("onnx/tiny-siglip-")
    assert max(found.image_distance, found.text_distance) < 1e-5
    encoder, model = load_encoder(f"onnx:{tmp_path / 'out'}", Options()), transformers.AutoModel.from_pretrained(source)
    look, tokenizer = (
        kind.from_pretrained(source) for kind in (transformers.AutoImageProcessor, transformers.AutoTokenizer)
    )
    crops = [rng.integers(0, 256, (32, 32, 3), dtype=np.uint8) for _ in range(3)]
    texts = ["a kitchen", "a picture of a kitchen", "a photo of a kitchen"]
    how = {"padding": "max_length", "max_length": tiny_models.CONTEXT, "truncation": True, "return_tensors": "pt"}
    with torch.inference_mode():
        images = model.vision_model(**look(images=crops, return_tensors="pt")).pooler_output
        rows = model.text_model(input_ids=tokenizer(texts, **how)["input_ids"]).pooler_output
    images = images / images.norm(dim=1, keepdim=True)
    mean = (rows / rows.norm(dim=1, keepdim=True)).mean(dim=0)
    assert encoder.encode_images(crops) == pytest.approx(images.numpy(), abs=1e-5)
    ours = encoder.encode_text([["a kitchen"], ["A Kitchen"]]).embeddings
    assert ours[0] == pytest.approx((mean / mean.norm()).numpy(), abs=1e-5)
    assert ours[1] == pytest.approx(ours[0], abs=1e-6)


def test_the_first_siglips_sentence_pieces(tmp_path):
    pytest.importorskip("sentencepiece")
    source = tiny_models.sentence_pieces(tiny_models.siglip_folder(tmp_path / "tiny-siglip"))
    assert exporting.export(f"siglip/{source}", tmp_path / "out").text_distance < 1e-5


def test_siglip_without_what_it_needs_is_one_sentence(tmp_path, monkeypatch):
    with pytest.raises(ExportError, match="write siglip/HF_NAME"):
        exporting.export("siglip/", tmp_path / "out")
    transformers = pytest.importorskip("transformers")
    with pytest.raises(EncoderUnavailable, match=r"cannot be loaded .*; name a folder with them") as failure:
        exporting.export(f"siglip/{tmp_path}", tmp_path / "out")
    assert "\n" not in str(failure.value)
    transformers.BertConfig().save_pretrained(tmp_path / "bert")
    with pytest.raises(ExportError, match="is a model of the kind bert; siglip/HF_NAME takes SigLIP only"):
        exporting.export(f"siglip/{tmp_path / 'bert'}", tmp_path / "out")
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(EncoderUnavailable, match="transformers is not installed; run `pip install transformers`"):
        exporting.export("siglip/google/siglip-base-patch16-224", tmp_path / "out")


def test_the_commands(tiny, tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    assert main(["encoders", "export", tiny[0], "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"use it with --encoder onnx:{out}" in said and "(allowed: 1e-03)" in said
    assert main(["encoders", "check", f"onnx:{out}"]) == 0
    said = capsys.readouterr().out
    assert "32 numbers, crops of 32 px" in said and "crops per second" in said
    assert main(["encoders", "export", "open_clip/ViT-B-32/laion9b", "--out", str(tmp_path / "none")]) == 1
    failed = capsys.readouterr().err
    assert failed.count("\n") == 1 and "choose from openai" in failed and not (tmp_path / "none").exists()
    assert main(["encoders", "export", "conse/x", "--out", str(tmp_path / "none")]) == 1
    assert "write open_clip/MODEL/PRETRAINED or siglip/HF_NAME" in capsys.readouterr().err
