"""Detected objects: a ray-cast room of known boxes, lifting by hand, tiny networks, and the worker's contract."""

import json

import cv2
import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.objects import Detections
from prior_sg.schemas.priors import ObjectPrior, PriorList, PriorRequest, TaskInForce, TaskRequest
from prior_sg.services import intent
from prior_sg.services.feature_pyramid import service
from prior_sg.services.feature_pyramid.core import lift
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.core.lift import Grid
from prior_sg.services.feature_pyramid.detectors.base import Detector, Found, Shot
from prior_sg.services.feature_pyramid.detectors.load import load_detector
from prior_sg.services.feature_pyramid.detectors.masks import load_masks
from prior_sg.services.feature_pyramid.detectors.prompted import as_sentences, batches, best_sentence
from prior_sg.services.feature_pyramid.encoders import torchvision_parts
from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable
from prior_sg.services.runtime.runner import Runner
from tests.help.long import long_run
from tests.help.world import prior, task

CAMERA = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
# looking along world x: camera x is world -y, camera y is world -z
POSE = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
ROOM = ((-1.0, -2.5, 0.0), (5.0, 2.5, 2.6))
BOXES = [((3.0, -1.5, 0.0), (3.6, -0.7, 0.8)), ((2.5, 0.5, 0.0), (3.0, 1.3, 1.0))]
PICTURE = ((-0.4, 1.3), (0.4, 1.9))  # y, z on the wall opposite


def room():
    """Colour, depth in metres, and which box every pixel shows (-1 = none, 2 = the picture), by intersecting slabs."""
    v, u = np.indices((480, 640), dtype=np.float64)
    rays = np.stack([(u - 320) / 500, (v - 240) / 500, np.ones_like(u)], axis=-1) @ POSE[:3, :3].T
    with np.errstate(divide="ignore"):
        near, far = _slabs(rays, ROOM)
        depth_m, shown = far, np.full(far.shape, -1)
        for index, box in enumerate(BOXES):
            near, far = _slabs(rays, box)
            hit = (near <= far) & (near > 0) & (near < depth_m)
            depth_m, shown = np.where(hit, near, depth_m), np.where(hit, index, shown)
    points = POSE[:3, 3] + rays * depth_m[..., None]
    low, high = PICTURE
    on = (np.abs(points[..., 0] - 5) < 1e-6) & (shown < 0)
    on &= (points[..., 1:] > low).all(axis=-1) & (points[..., 1:] < high).all(axis=-1)
    shown[on] = 2
    color = np.full((480, 640, 3), 190, np.uint8)
    color[on] = (160, 40, 30)
    return color, depth_m.astype(np.float32), shown


def _slabs(rays, box):
    ends = [(np.array(corner) - POSE[:3, 3]) / rays for corner in box]
    return np.minimum(*ends).max(axis=-1), np.maximum(*ends).min(axis=-1)


def keyframe(color, depth_m):
    depth = depth_m if isinstance(depth_m, bytes) else np.round(depth_m * 1000).astype(np.uint16)
    png = [part if isinstance(part, bytes) else cv2.imencode(".png", part)[1].tobytes() for part in (color, depth)]
    return Keyframe(
        robot="ada",
        frame_id=5,
        stamp_ns=123,
        intrinsics=CAMERA,
        world_from_camera=POSE,
        color=png[0],
        depth=png[1],
        depth_scale_m=0.001,
    )


class Colours:
    """An encoder that embeds a crop as its mean colour."""

    space, dim, side_px, batch_size = "colours", 3, 224, 8

    def encode_images(self, crops):
        means = np.array([crop.reshape(-1, 3).mean(axis=0) + 1 for crop in crops], np.float32).reshape(-1, 3)
        return means / np.linalg.norm(means, axis=1, keepdims=True)


def worked(frame, cfg):
    state = service.Worker("worker-7", Colours(), load_detector(cfg))
    try:
        (_, pyramid), (_, detections) = Runner(service.SERVICE, cfg, state=state).feed(frame)
    finally:
        state.reader.shutdown()
    return pyramid, detections


def test_segments_are_the_furniture_and_the_picture_and_nothing_of_the_room():
    color, depth_m, shown = room()
    found = load_detector(Config()).detect(Shot(color, depth_m, CAMERA, POSE))
    coarse = shown[2::4, 2::4]
    matched = [int(np.bincount(coarse[one.mask] + 1, minlength=4).argmax()) - 1 for one in found]
    assert sorted(matched) == [0, 1, 2]
    for one, index in zip(found, matched, strict=True):
        truth = coarse == index
        assert (one.mask & truth).sum() / (one.mask | truth).sum() > 0.8
        rows, columns = np.nonzero(shown == index)
        edges = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        assert one.box_px == pytest.approx(edges, abs=14)  # a few cells at the foot are floor
        assert (one.score == 1.0) == (edges[3] < 480)  # whether the image's border cuts it


@pytest.mark.parametrize("turn", [0.0, 0.6, 2.0])
def test_segments_do_not_depend_on_the_heading(turn):
    color, depth_m, _ = room()
    heading = np.eye(4)
    heading[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    detector = load_detector(Config())
    assert len(detector.detect(Shot(color, depth_m, CAMERA, heading @ POSE))) == 3


def test_an_empty_room_has_no_objects():
    v, u = np.indices((480, 640), dtype=np.float64)
    rays = np.stack([(u - 320) / 500, (v - 240) / 500, np.ones_like(u)], axis=-1) @ POSE[:3, :3].T
    with np.errstate(divide="ignore"):
        depth_m = _slabs(rays, ROOM)[1].astype(np.float32)
    color = np.full((480, 640, 3), 190, np.uint8)
    assert load_detector(Config()).detect(Shot(color, depth_m, CAMERA, POSE)) == []


def test_lifting_by_hand():
    """Cells of 4 px sit at pixels 2, 6, ...: cell (60, 80) is the pixel u = 322, v = 242."""
    depth_m = np.zeros((480, 640), np.float32)
    depth_m[242, 322], depth_m[242, 326] = 2.0, 4.0
    mask = np.zeros((120, 160), bool)
    mask[60, 80:83] = True  # the third cell has no measurement
    empty = np.zeros_like(mask)
    empty[0, 0] = True
    found = [Found(np.zeros(4, np.float32), part, 0.5) for part in (mask, empty)]
    kept, points_m = lift.lift(found, depth_m, CAMERA, Config())
    assert kept == found[:1]  # nothing measured: no object
    # (322 - 320) / 500 * 2 = 0.008; (326 - 320) / 500 * 4 = 0.048, (242 - 240) / 500 * 4 = 0.016
    np.testing.assert_allclose(points_m[0], [[0.008, 0.008, 2.0], [0.048, 0.016, 4.0]], atol=1e-6)


def test_one_point_per_cube():
    depth_m = np.full((480, 640), 2.02, np.float32)
    found = [Found(np.zeros(4, np.float32), np.ones((120, 160), bool), 1.0)]
    (points_m,) = lift.lift(found, depth_m, CAMERA, Config(object_point_m=0.5))[1]
    cubes = np.floor(points_m / 0.5).astype(int)
    assert len(np.unique(cubes, axis=0)) == len(cubes)
    # x from -1.29 to 1.28 and y from -0.97 to 0.96: cubes -3 .. 2 and -2 .. 1
    assert len(points_m) == 6 * 4


def test_crops_are_squares_around_the_boxes_inside_the_image():
    boxes = [(100, 100, 200, 150), (0, 0, 50, 20), (0, 0, 640, 480)]
    found = [Found(np.array(box, np.float32), np.ones((1, 1), bool), 1.0) for box in boxes]
    crops = lift.object_crops(found, 640, 480)
    assert crops.side_px.tolist() == [120, 60, 480]  # 1.2 longer sides, at most the image's shorter side
    assert crops.left_px.tolist() == [90, 0, 80] and crops.top_px.tolist() == [65, 0, 0]


def test_masks_in_boxes_leave_out_what_is_in_front_and_behind():
    depth_m = np.full((480, 640), 5.0, np.float32)
    depth_m[160:320, 240:400] = 2.0
    depth_m[160:320, 240:260] = 0.5
    mask = lift.mask_in_box(np.array([200, 120, 440, 360], np.float32), Grid.of(depth_m, 4), CAMERA)
    expected = np.zeros((120, 160), bool)
    expected[40:80, 65:100] = True
    assert (mask == expected).all()
    assert not lift.mask_in_box(np.array([0, 0, 9, 9]), Grid.of(np.zeros((480, 640)), 4), CAMERA).any()


def test_doubles_by_hand():
    """Intersection over union of the first two 90 / 110, of the first and the third 0."""
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [20, 0, 30, 10]], np.float32)
    assert lift.without_doubles(boxes, np.array([0.5, 0.9, 0.1])).tolist() == [1, 2]
    assert lift.without_doubles(boxes, np.array([0.5, 0.9, 0.1]), 0.85).tolist() == [1, 0, 2]


def test_detections_of_a_keyframe():
    color, depth_m, _ = room()
    pyramid, detections = worked(keyframe(color[:, :, ::-1], depth_m), Config())
    assert decode(Detections, encode(detections)) == detections
    assert (detections.detector, detections.prompted, detections.worker) == ("segments", False, "worker-7")
    assert (detections.surface_m == pyramid.surface_m.astype(np.float16)).all()
    assert len(detections.scores) == 3
    points = np.split(detections.points_camera_m.astype(float), np.cumsum(detections.point_counts)[:-1])
    middles = sorted(np.median(part @ POSE[:3, :3].T + POSE[:3, 3], axis=0).round(1).tolist() for part in points)
    assert middles[0][0] == pytest.approx(2.5, abs=0.2) and middles[2][0] == pytest.approx(5.0, abs=0.05)
    picture = next(i for i, part in enumerate(points) if np.median(part[:, 2]) > 4.5)
    red = detections.embeddings[picture].astype(float)
    assert red[0] > 1.3 * red[1]  # its crop is encoded, not the room's
    others = [row for i, row in enumerate(detections.embeddings.astype(float)) if i != picture]
    assert all(row == pytest.approx(np.full(3, 3**-0.5), abs=0.02) for row in others)


def test_a_broken_image_gives_no_detections():
    for color, depth_m in ((b"", np.full((480, 640), 4.0)), (np.zeros((480, 640, 3), np.uint8), b"")):
        _, detections = worked(keyframe(color, depth_m), Config())
        assert len(detections.scores) == 0 and detections.embeddings.shape == (0, 3)
        assert decode(Detections, encode(detections)) == detections


def test_detection_can_be_switched_off():
    color, depth_m, _ = room()
    _, detections = worked(keyframe(color, depth_m), Config(detector="none"))
    assert detections.detector == "none" and len(detections.scores) == 0


@pytest.mark.parametrize(
    ("setting", "masks", "why"),
    [
        ("segmnets", "depth", "no detector is called 'segmnets'"),
        ("owlv2:", "depth", "no detector is called 'owlv2:'"),
        pytest.param(
            "owlv2:/nowhere", "depth", "weights of the detector owlv2:/nowhere cannot be loaded", marks=long_run
        ),
        pytest.param("grounding_dino:/nowhere", "depth", "cannot be loaded", marks=long_run),
        ("segments", "sam:/nowhere", "'segments' has none"),
    ],
)
def test_a_detector_that_cannot_be_loaded_says_so_in_a_sentence(setting, masks, why):
    with pytest.raises(EncoderUnavailable, match=why) as caught:
        load_detector(Config(detector=setting, detector_masks=masks))
    assert str(caught.value).count("\n") == 0 and str(caught.value).endswith(".")


def owlv2(folder):
    """A small OWLv2 with random weights that reads letters."""
    import transformers

    letters = [end for letter in "abcdefghijklmnopqrstuvwxyz" for end in (letter, f"{letter}</w>")]
    intent = {token: index for index, token in enumerate([*letters, "<|startoftext|>", "<|endoftext|>"])}
    (folder / "vocab.json").write_text(json.dumps(intent))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = transformers.CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=16)
    images = transformers.Owlv2ImageProcessor(size={"height": 64, "width": 64})
    transformers.Owlv2Processor(images, tokenizer).save_pretrained(folder)
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    ends = {"bos_token_id": len(letters), "eos_token_id": len(letters) + 1, "pad_token_id": 0}
    text = small | ends | {"vocab_size": len(intent), "max_position_embeddings": 16}
    vision = small | {"image_size": 64, "patch_size": 16}
    config = transformers.Owlv2Config(text_config=text, vision_config=vision, projection_dim=16)
    model = transformers.Owlv2ForObjectDetection(config)
    for parameter in model.box_head.parameters():
        parameter.data *= 0.3  # boxes near its patches, of which 16 cover the image
    model.save_pretrained(folder)


def grounding_dino(folder):
    """A small GroundingDINO with random weights that knows two words."""
    import transformers

    (folder / "vocab.txt").write_text("\n".join(["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "stove", "bed"]))
    tokenizer = transformers.BertTokenizer(str(folder / "vocab.txt"))
    images = transformers.GroundingDinoImageProcessor(size={"shortest_edge": 64, "longest_edge": 96})
    transformers.GroundingDinoProcessor(images, tokenizer).save_pretrained(folder)
    backbone = transformers.SwinConfig(
        image_size=64,
        embed_dim=8,
        depths=[1] * 4,
        num_heads=[1] * 4,
        window_size=2,
        out_features=["stage2", "stage3", "stage4"],
    )
    text = {"model_type": "bert", "vocab_size": 8, "hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    layers = {f"{part}_{what}": 2 for part in ("encoder", "decoder") for what in ("layers", "attention_heads")}
    config = transformers.GroundingDinoConfig(
        backbone_config=backbone, text_config=text | {"intermediate_size": 16}, d_model=32, num_queries=6, **layers
    )
    transformers.GroundingDinoForObjectDetection(config).save_pretrained(folder)


@pytest.mark.parametrize("network", [owlv2, grounding_dino])
def test_prompted_detectors_give_the_boxes_that_transformers_gives(network, tmp_path):
    torch = pytest.importorskip("torch")
    torchvision_parts.load_if_installed()
    torch.manual_seed(0)
    network(tmp_path)
    cfg = Config(detector=f"{network.__name__}:{tmp_path}", detector_threshold=0.0, device="cpu")
    detector = load_detector(cfg)
    color = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    boxes_px, scores, names = detector.boxes(color, ("stove", "bed"))
    if network is owlv2:
        prompts, padding = [["a photo of a stove", "a photo of a bed"]], "max_length"
    else:
        prompts, padding = "stove. bed.", True
    read = detector.processor.image_processor.post_process_object_detection
    asked = detector.processor(images=[color], text=prompts, padding=padding, truncation=True, return_tensors="pt")
    with torch.inference_mode():
        outputs = detector.model(**asked)
    theirs = read(outputs, threshold=0.0, target_sizes=[(480, 640)])[0]
    expected = np.clip(theirs["boxes"].numpy(), 0, (640, 480, 640, 480))
    inside = (expected[:, 2:] - expected[:, :2] >= 1).all(axis=1)
    assert inside.any()
    np.testing.assert_allclose(boxes_px, expected[inside], atol=0.01)
    np.testing.assert_allclose(scores, theirs["scores"].numpy()[inside], atol=1e-5)
    each = outputs.logits[0].numpy()[:, [0, 1] if network is owlv2 else [1, 3]]  # one token each, after [CLS]
    assert names.tolist() == each[inside].argmax(axis=1).tolist() and len(set(names.tolist())) == 2
    alone = detector.boxes(color, ("bed",))
    assert set(alone[2].tolist()) == {0}
    shot = Shot(color, np.full((480, 640), 3.0, np.float32), CAMERA, POSE)
    found = detector.detect(shot, ("stove", "bed"))
    assert found and all(one.mask.any() for one in found)
    assert [one.score for one in found] == sorted((one.score for one in found), reverse=True)
    assert detector.detect(shot) == []


def test_names_of_several_tokens_by_hand():
    """[CLS] office chair . sofa . : the mean over a name's tokens decides, not the single best token."""
    scores = np.array([[0, 0.9, 0.1, 0, 0.6, 0, 0, 0], [0, 0.8, 0.7, 0, 0.6, 0, 0, 0]])
    assert best_sentence(scores, [101, 7, 8, 9, 5, 9, 102], stop=9).tolist() == [1, 0]
    assert as_sentences(("Office chair", "St. Bernard dog.")) == "office chair. st  bernard dog."


def test_a_name_without_tokens_scores_nothing_and_long_lists_are_asked_in_parts():
    scores = np.array([[0.0, 0.2, 0.1, 0.3, 0.1]])
    assert best_sentence(scores, [101, 9, 7, 9, 102], stop=9).tolist() == [1]  # ". bed."
    assert batches([3, 3, 3, 9, 1], 6) == [(0, 2), (2, 3), (3, 4), (4, 5)]
    assert batches([3], 6) == [(0, 1)]


def sam(folder):
    """A small SAM with random weights."""
    import transformers

    images = transformers.SamImageProcessor(size={"longest_edge": 64}, pad_size={"height": 64, "width": 64})
    transformers.SamProcessor(images).save_pretrained(folder)
    small = {"hidden_size": 16, "num_attention_heads": 2}
    vision = small | {"num_hidden_layers": 1, "image_size": 64, "output_channels": 16, "global_attn_indexes": [0]}
    prompts = {"hidden_size": 16, "image_size": 64, "image_embedding_size": 4, "mask_input_channels": 4}
    config = transformers.SamConfig(
        vision_config=vision | {"mlp_dim": 16, "num_pos_feats": 8},
        prompt_encoder_config=prompts,
        mask_decoder_config=small | {"mlp_dim": 16, "num_hidden_layers": 1, "iou_head_hidden_dim": 16},
    )
    transformers.SamModel(config).save_pretrained(folder)


def test_masks_are_those_that_transformers_gives(tmp_path):
    torch = pytest.importorskip("torch")
    torchvision_parts.load_if_installed()
    torch.manual_seed(0)
    sam(tmp_path)
    cfg = Config(detector="owlv2:x", detector_masks=f"sam:{tmp_path}", device="cpu")
    masks = load_masks(cfg)
    color = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    boxes_px = np.array([[40, 60, 300, 400], [320, 10, 630, 200]], np.float32)
    depth_m = np.full((480, 640), 3.0, np.float32)
    depth_m[:, 500:] = 0
    ours = masks.of(color, boxes_px, Grid.of(depth_m, 4))
    asked = masks.processor(images=[color], input_boxes=[boxes_px.tolist()], return_tensors="pt")
    with torch.inference_mode():
        outputs = masks.model(**asked)
    sizes = (asked["original_sizes"], asked["reshaped_input_sizes"])
    theirs = masks.processor.image_processor.post_process_masks(outputs.pred_masks, *sizes)[0]
    assert len(ours) == 2
    for index, mask in enumerate(ours):
        full = theirs[index, outputs.iou_scores[0, index].argmax()].numpy()
        assert full.shape == (480, 640) and 0 < full.mean() < 1
        assert (mask == full[2::4, 2::4] & (depth_m[2::4, 2::4] > 0)).all()
    assert masks.of(color, boxes_px[:0], Grid.of(depth_m, 4)) == []


class Named(Detector):
    """Finds the picture's place on the wall, under the last name that is sought."""

    name, prompted = "named", True

    def detect(self, shot, sought=()):
        if not sought:
            return []
        mask = np.zeros((120, 160), bool)
        mask[20:40, 60:90] = True
        return [Found(np.array([240, 80, 360, 160], np.float32), mask, 0.9, len(sought) - 1)]


def ready():
    """A worker with that detector."""
    cfg = Config()
    return service.Worker("worker-7", Colours(), Named()), cfg


def ran(state, cfg, *messages):
    """What steps on messages yield: questions, and outputs by topic."""
    runner = Runner(service.SERVICE, cfg, state=state)
    outputs = [(topic.name, message) for topic, message in runner.feed(*messages)]
    return [ask.request for ask in runner.asks], outputs


def test_a_prompted_detector_looks_for_the_objects_of_the_robots_prior():
    color, depth_m, _ = room()
    frame = keyframe(color, depth_m)
    state, cfg = ready()
    asked, outputs = ran(state, cfg, frame)
    assert asked == [TaskRequest(robot="ada")] and [name for name, _ in outputs] == ["PYRAMID"]
    job = prior(["kitchen", "bedroom"])
    mine = task(robot="ada", environment=job.environment, task=job.task)
    asked, outputs = ran(state, cfg, TaskInForce(robot="ada", task=mine), frame)
    assert asked == [PriorRequest(environment=job.environment, task=job.task, regions=[])]
    assert [name for name, _ in outputs] == ["PYRAMID"]
    asked, outputs = ran(state, cfg, PriorList(priors=[job]), frame)
    assert asked == [] and [name for name, _ in outputs] == ["PYRAMID", "DETECTIONS"]
    detections = decode(Detections, encode(outputs[1][1]))
    assert detections.sought == [item.name for item in job.objects] == ["oven", "bed"]
    assert detections.names.tolist() == [1] and detections.prompted
    other = msgspec.structs.replace(frame, robot="bob")
    assert ran(state, cfg, other)[0] == [TaskRequest(robot="bob")]
    fixed = Config(detector_prompts=("lamp",))
    asked, outputs = ran(service.Worker("w", Colours(), Named()), fixed, frame)
    assert asked == [] and outputs[1][1].sought == ["lamp"]


def test_a_keyframe_made_ready_before_the_prior_changed_is_looked_at_again():
    color, depth_m, _ = room()
    frame, job = keyframe(color, depth_m), prior(["kitchen", "bedroom"])
    orders = []
    for ahead in (True, False):
        state, cfg = ready()
        if ahead:
            service.prepare(state, [frame], cfg)
        mine = task(robot="ada", environment=job.environment, task=job.task)
        _, outputs = ran(state, cfg, mine, job, frame)
        orders.append([encode(message) for _, message in outputs])
        assert outputs[1][1].names.tolist() == [1] and not state.views
        service.SERVICE.close(state)
    assert orders[0] == orders[1]


def test_the_newest_task_and_the_newest_prior_for_it_count():
    known = intent.Intent()
    home = prior(["kitchen"])
    first, second = (
        task(robot="ada", stamp_ns=stamp, environment="e", task=name) for stamp, name in ((5, "a"), (7, "b"))
    )
    answers = [
        msgspec.structs.replace(
            home, environment="e", task=name, objects=[ObjectPrior(name=o, phrases=[o]), home.objects[1]]
        )
        for name, o in (("a", "sofa"), ("b", "lamp"), ("b", "shelf"))
    ]
    for message in (second, first, *answers):
        intent.hear(known, message)
    assert intent.objects(known, "ada") == ("shelf", "bed")
    intent.hear(known, answers[1])  # told again: it is the newest
    assert intent.objects(known, "ada") == ("lamp", "bed")
    assert list(intent.questions(known, "ada")) == [] and intent.objects(known, "bob") == ()


def test_priors_that_answer_a_task_are_remembered_longest_and_asked_for_again():
    known, home = intent.Intent(), prior(["kitchen"])
    intent.hear(known, task(robot="ada", environment=home.environment, task=home.task))
    assert len(list(intent.questions(known, "ada"))) == len(list(intent.questions(known, "ada"))) == 1
    intent.hear(known, home)
    for number in range(2 * intent.REMEMBERED):
        intent.hear(known, msgspec.structs.replace(home, task=f"another {number}"))
    assert len(known.priors) == intent.REMEMBERED and intent.objects(known, "ada") == ("oven", "bed")
