"""Objects: synthetic boxes seen from a walk become objects with lasting ids; names, deltas, pose corrections."""

import math

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.objects import Detections, ObjectDelta
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.priors import ObjectPrior, RegionPrior
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import OBJECT_SNAPSHOT, TEXT
from prior_sg.services.geometry import inverse, transform
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.objects import names as naming
from prior_sg.services.segmenter.core.objects import splitting
from prior_sg.services.segmenter.core.objects.association import observe
from prior_sg.services.segmenter.core.objects.cells import connected, packed, shared, unpacked
from prior_sg.services.segmenter.core.objects.object_map import ObjectMap
from prior_sg.services.segmenter.core.objects.renewal import renew
from prior_sg.services.segmenter.core.objects.track import TrackingConfig, descriptor
from prior_sg.services.segmenter.core.objects.tracks import Tracks, move, outdated
from prior_sg.services.segmenter.service import SERVICE
from tests.help.world import CAMERA, DIM, ROBOT, SPACE, look, place_delta, place_grid, prior, task, text

CFG = TrackingConfig()
EYE = np.eye(DIM)
BED = (np.array((2.0, 1.0, 0.0)), np.array((3.2, 2.6, 0.6)), 1)  # low and high corner, axis of its embedding
OVEN = (np.array((2.0, -2.0, 0.0)), np.array((2.6, -1.4, 0.9)), 0)
TICK = Tick(stamp_ns=10**18)


def faces(low, high, step=0.05):
    """Points on the surface of a box."""
    grids = [np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, 3)
    return points[(np.isclose(points, low) | np.isclose(points, high)).any(axis=1)]


def side(box, eye, step=0.05):
    """The faces of a box that an eye sees."""
    low, high, _ = box
    points = faces(low, high, step)
    shown = [(np.isclose(points[:, a], low[a]) & (eye[a] < low[a])) for a in range(3)]
    shown += [(np.isclose(points[:, a], high[a]) & (eye[a] > high[a])) for a in range(3)]
    return points[np.any(shown, axis=0)]


def sight(frame_id, pose, boxes, *, said=None, surface_m=9.0, **changes):
    """Detections of some boxes from a pose; `said` is the pose that the message claims."""
    clouds = [transform(inverse(pose), side(box, pose[:3, 3])) for box in boxes]
    rng = np.random.default_rng(frame_id)
    vectors = np.array([EYE[box[2]] for box in boxes]).reshape(-1, DIM) + 0.05 * rng.standard_normal((len(boxes), DIM))
    fields = {
        "robot": ROBOT,
        "frame_id": frame_id,
        "stamp_ns": frame_id,
        "space": SPACE,
        "detector": "segments",
        "prompted": False,
        "worker": "w",
        "intrinsics": CAMERA,
        "world_from_camera": pose if said is None else said,
        "boxes_px": np.zeros((len(boxes), 4), np.float32),
        "scores": np.ones(len(boxes), np.float32),
        "embeddings": (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16),
        "point_counts": np.array([len(cloud) for cloud in clouds], np.int32),
        "points_camera_m": np.concatenate([np.zeros((0, 3)), *clouds]).astype(np.float16),
        "surface_m": np.full((12, 16), surface_m, np.float16),
    }
    message = Detections(**(fields | changes))
    return decode(Detections, encode(message))


def walk(count=8):
    """Poses around the boxes, looking at the middle between them."""
    angles = np.linspace(-0.6, 0.6, count)
    return [look(2.5 - 4 * np.cos(a), 0.0 - 4 * np.sin(a), a) for a in angles]


def seen(frames, cfg=CFG):
    tracks = Tracks(SPACE)
    for frame in frames:
        assert observe(tracks, frame, cfg)
    return tracks


def test_boxes_seen_from_a_walk_become_one_object_each_with_their_size():
    tracks = seen([sight(i, pose, [BED, OVEN] if i % 2 else [OVEN, BED]) for i, pose in enumerate(walk())])
    assert len(tracks.items) == 2
    for track in tracks.items.values():
        vector = descriptor(track.embeddings)
        low, high, axis = BED if vector[1] > vector[0] else OVEN
        assert vector[axis] > 0.97 and track.frames == 8
        found = track.box_m(CFG)
        assert np.abs(found[0, :2] - low[:2]).max() < 0.5 and np.abs(found[1, 2] - high[2]) <= CFG.cell_m + 0.01
        assert (np.abs(found.mean(axis=0) - (low + high) / 2) < 0.4).all()


def test_a_repeated_frame_changes_nothing():
    frame = sight(0, walk()[0], [BED])
    tracks = seen([frame])
    assert not observe(tracks, frame, CFG)
    assert [track.frames for track in tracks.items.values()] == [1]


def test_halves_become_one_object_when_two_views_join_them_and_the_older_id_stays():
    pose = look(-1.0, 1.8, 0.0)
    middle = (BED[0][1] + BED[1][1]) / 2
    left = (BED[0], np.array((BED[1][0], middle - 0.1, BED[1][2])), 1)
    right = (np.array((BED[0][0], middle + 0.1, BED[0][2])), BED[1], 1)
    frames = [sight(0, pose, [left, right]), sight(1, pose, [left, right])]
    tracks = seen(frames)
    assert sorted(tracks.items) == [0, 1]
    observe(tracks, sight(2, pose, [BED]), CFG)
    assert sorted(tracks.items) == [0, 1]  # one look may err
    observe(tracks, sight(3, pose, [BED]), CFG)
    assert sorted(tracks.items) == [0]
    assert tracks.merged == [(1, 0)]


def test_two_objects_with_the_same_cells_merge_into_the_older():
    tracks = seen([sight(0, walk()[3], [BED]), sight(1, walk()[3], [OVEN])])
    younger, older = tracks.items[1], tracks.items[0]
    younger.cells, younger.hits, younger.bounds = older.cells.copy(), older.hits.copy(), older.bounds.copy()
    observe(tracks, sight(2, walk()[3], [BED]), CFG)
    assert list(tracks.items) == [0] and tracks.merged == [(1, 0)]
    assert tracks.items[0].frames == 3


def halves_of_the_bed(gap_m):
    """Two boxes, and their embeddings' axes, that one careless look takes for one bed."""
    middle = (BED[0][1] + BED[1][1]) / 2
    left = (BED[0], np.array((BED[1][0], middle - gap_m / 2, BED[1][2])), 1)
    right = (np.array((BED[0][0], middle + gap_m / 2, BED[0][2])), BED[1], 0)
    return left, right


def test_two_objects_that_the_first_looks_took_for_one_are_split_and_the_one_seen_more_keeps_the_id():
    pose = look(-1.0, 1.8, 0.0)
    left, right = halves_of_the_bed(0.8)
    frames = [sight(i, pose, [BED]) for i in range(2)]
    frames += [sight(2 + i, pose, [left, right]) for i in range(12)]
    frames += [sight(14 + i, pose, [left]) for i in range(4)]
    tracks = Tracks(SPACE)
    ids = []
    for frame in frames:
        observe(tracks, frame, CFG)
        ids.append(sorted(tracks.items))
    assert ids[1] == [0] and ids[-1][0] == 0 and len(ids[-1]) == 2 and ids[-1] == ids[13]
    first, second = tracks.items.values()
    for track, truth in ((first, left), (second, right)):
        assert track.box_m(CFG) == pytest.approx(np.array(truth[:2]), abs=2 * CFG.cell_m)
        assert descriptor(track.embeddings)[truth[2]] > 0.9
    assert first.frames > second.frames >= 10 and not first.sources & second.sources
    again = Tracks(SPACE, archive=dict(tracks.archive))
    renew(again, SPACE, 99, CFG)
    assert [set(track.sources) for track in again.items.values()] == [first.sources, second.sources]


def test_an_object_that_a_post_cuts_in_two_but_every_look_shows_whole_stays_one():
    pose = look(-1.0, 1.8, 0.0)
    parts = halves_of_the_bed(0.8)
    clouds = [transform(inverse(pose), side(part, pose[:3, 3])) for part in parts]
    whole = sight(0, pose, [BED])
    points = np.concatenate(clouds).astype(np.float16)
    tracks = Tracks(SPACE)
    for number in range(20):
        counts = np.array([len(points)], np.int32)
        frame = msgspec.structs.replace(whole, frame_id=number, points_camera_m=points, point_counts=counts)
        observe(tracks, frame, CFG)
    (track,) = tracks.items.values()
    assert len(connected(track.firm(CFG.firm_share))) == 2 and track.frames == 20


def test_parts_against_a_flood_fill():
    rng = np.random.default_rng(3)
    numbers = np.unique(rng.integers(0, 12, (220, 3)), axis=0)
    waiting, groups = {tuple(row) for row in numbers.tolist()}, []
    while waiting:
        group, edge = set(), [waiting.pop()]
        while edge:
            cell = edge.pop()
            group.add(cell)
            close = {other for other in waiting if max(abs(a - b) for a, b in zip(cell, other, strict=True)) <= 1}
            waiting -= close
            edge += close
        groups.append(group)
    parts = connected(np.sort(packed(numbers)))
    assert len(groups) > 3
    assert sorted(sorted(map(tuple, unpacked(part).tolist())) for part in parts) == sorted(map(sorted, groups))
    assert [len(part) for part in parts] == sorted(map(len, groups), reverse=True)


@pytest.mark.parametrize(("surface_m", "left"), [(9.0, 0), (1.0, 1)], ids=["looked at", "hidden"])
def test_what_later_frames_look_at_in_vain_was_no_object(surface_m, left):
    pose = look(-1.0, 1.8, 0.0)
    tracks = seen([sight(0, pose, [BED])])
    for number in range(1, CFG.patience_frames + 1):
        assert len(tracks.items) == 1
        observe(tracks, sight(number, pose, [], surface_m=surface_m), CFG)
    assert len(tracks.items) == left


def test_centrality_by_hand():
    """Two alike at cosine 1 and an outlier at cosine 0: weights 1/2, 1/2, 0, so the outlier leaves no trace."""
    one, other = EYE[0], EYE[1]
    assert np.allclose(descriptor([one, one, other]), one)
    assert np.allclose(descriptor([one, other]), (one + other) / np.sqrt(2))  # none is central: alike
    assert np.allclose(descriptor([other]), other)


def test_centrality_against_a_literal_loop():
    rng = np.random.default_rng(3)
    rows = rng.standard_normal((9, 16)) + 0.5
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    total = np.zeros(16)
    for k, row in enumerate(rows):
        cosines = [float(row @ rows[j]) for j in range(len(rows)) if j != k]
        total += max(sum(cosines) / len(cosines), 0.0) * row
    assert np.abs(descriptor(list(rows)) - total / np.linalg.norm(total)).max() < 1e-12


def test_packed_cells_come_back_and_neighbours_are_near():
    rng = np.random.default_rng(0)
    numbers = rng.integers(-500, 500, (200, 3))
    assert (unpacked(packed(numbers)) == numbers).all()
    cells = np.sort(packed(np.array([(0, 0, 0), (5, 5, 5)])))
    assert shared(cells, np.sort(packed(np.array([(1, -1, 1)])))) == 0.5
    assert shared(cells, np.sort(packed(np.array([(2, 0, 0)])))) == 0.0


def test_a_pose_correction_moves_the_object_and_keeps_its_id():
    off = np.eye(4)
    off[:3, 3] = (0.0, 3.0, 0.0)
    poses = walk()
    truth = seen([sight(i, pose, [BED, OVEN]) for i, pose in enumerate(poses)])
    tracks = seen([sight(i, pose, [BED, OVEN], said=off @ pose) for i, pose in enumerate(poses)])
    tracks.next_id = 50
    wrong = {number: track.box_m(CFG) for number, track in tracks.items.items()}
    for index, pose in enumerate(poses):
        move(tracks, {index: pose})
    renew(tracks, SPACE, 99, CFG)
    assert tracks.items.keys() == wrong.keys() and tracks.next_id == 50
    for number, track in tracks.items.items():
        assert (track.box_m(CFG) == truth.items[number].box_m(CFG)).all()
        assert wrong[number][0, 1] - track.box_m(CFG)[0, 1] == pytest.approx(3.0, abs=0.2)


def test_a_renewal_in_slices_with_new_frames_between_equals_one_in_one_go():
    off = np.eye(4)
    off[:3, 3] = (0.0, 3.0, 0.0)
    poses = walk(8)
    frames = [sight(i, pose, [BED, OVEN], said=off @ pose) for i, pose in enumerate(poses[:6])]
    late = [sight(i, poses[i], [BED, OVEN]) for i in (6, 7)]
    whole, sliced = seen(frames), seen(frames)
    for tracks in (whole, sliced):
        move(tracks, dict(enumerate(poses[:6])))
    renew(whole, SPACE, 99, CFG)
    for frame in late:
        observe(whole, frame, CFG)
    before = dict(sliced.items)
    for step in range(3):
        assert outdated(sliced, SPACE) and sliced.items == before
        renew(sliced, SPACE, 3, CFG)
        if step < 2:
            observe(sliced, late[step], CFG)
    assert not outdated(sliced, SPACE) and sliced.items.keys() == whole.items.keys() == before.keys()
    for number, track in whole.items.items():
        assert (sliced.items[number].cells == track.cells).all() and sliced.items[number].sources == track.sources


def late(frames, cfg=CFG):
    """A map of objects that heard the third of some frames last, and then nothing any more."""
    objects_of_map = ObjectMap(Tracks(space=SPACE))
    for frame in [*frames[:2], *frames[3:], frames[2]]:
        objects_of_map.observe(frame, cfg)
    return objects_of_map


def test_frames_that_came_late_are_put_in_their_place_when_no_more_come():
    poses = walk(8)
    # a bed of which the third look alone shows both halves, and a post that only the first saw
    frames = [
        sight(i, pose, [BED, OVEN] if i == 2 else [(BED[0], BED[1] - (0, 0.9, 0), 1)]) for i, pose in enumerate(poses)
    ]
    straight, crooked = seen(frames), late(frames)
    order = [sorted(track.sources) for track in crooked.tracks.items.values()]
    assert crooked.renew(SPACE, False, CFG) and order == [sorted(t.sources) for t in crooked.tracks.items.values()]
    assert crooked.renew(SPACE, True, CFG)
    for number, track in straight.items.items():
        again = crooked.tracks.items[number]
        assert all((one == other).all() for one, other in zip(track.embeddings, again.embeddings, strict=True))
        assert (again.cells == track.cells).all() and again.sources == track.sources
    assert straight.items.keys() == crooked.tracks.items.keys() and not crooked.tracks.disordered


def test_what_an_archive_has_lost_is_not_taken_from_the_objects_for_the_sake_of_order():
    cfg = TrackingConfig(archive_frames=4)
    crooked = late([sight(i, pose, [BED]) for i, pose in enumerate(walk(8))], cfg)
    assert crooked.renew(SPACE, True, cfg) and crooked.tracks.items[0].frames == 8


def test_corrections_at_every_tick_do_not_keep_the_objects_as_they_were():
    poses = walk(8)
    tracks = seen([sight(i, pose, [BED, OVEN]) for i, pose in enumerate(poses)])
    shift = np.eye(4)
    for tick in range(12):
        shift[1, 3] += 0.01
        move(tracks, {i: shift @ pose for i, pose in enumerate(poses)})
        observe(tracks, sight(100 + tick, shift @ poses[0], [BED, OVEN]), CFG)
        renew(tracks, SPACE, 8, CFG)
    assert tracks.items[0].frames > 8 and tracks.items[1].frames > 8
    while outdated(tracks, SPACE):
        renew(tracks, SPACE, 8, CFG)
    assert tracks.items[0].frames == tracks.items[1].frames == 8 + 12


def test_what_is_too_old_for_the_archive_is_neither_split_nor_lost_when_poses_change():
    cfg = TrackingConfig(archive_frames=6)
    poses = walk(8)
    tracks = seen([sight(i, pose, [BED]) for i, pose in enumerate(poses[:4])], cfg)
    for i in range(6):
        observe(tracks, sight(10 + i, poses[i], [OVEN]), cfg)
    before = tracks.items[0].cells
    assert splitting._halves(tracks, tracks.items[0], before[:1], before[-1:], cfg) is None
    move(tracks, {10: poses[0]})
    renew(tracks, SPACE, 99, cfg)
    assert sorted(tracks.items) == [0, 1] and (tracks.items[0].cells == before).all()


def test_embeddings_of_another_width_are_refused():
    tracks = seen([sight(0, walk()[0], [BED])])
    other = sight(1, walk()[1], [BED])
    wide = msgspec.structs.replace(other, embeddings=np.tile(other.embeddings, 2))
    assert not observe(tracks, wide, CFG) and len(tracks.archive) == 1


def test_beliefs_by_hand():
    """Standardised similarities 1 and -1 at temperature 2 beside none: e^2, e^-2 and e^2, then with evidence."""
    found = np.zeros((1, DIM))
    found[:, :2] = (0.55, 0.05)  # with mean 0.3 and spread 0.25
    for evidence in (np.zeros((1, 2)), np.log([[0.25, 3.0]])):
        rows, known = naming.beliefs(found, text(np.eye(2)), evidence)
        odds = np.exp([2.0, -2.0]) * np.exp(evidence[0])
        assert np.allclose(rows, odds / odds.sum(), atol=1e-6)
        assert known == pytest.approx([odds.sum() / (odds.sum() + math.exp(2.0**2 / 2))], abs=1e-6)


def test_known_is_what_bayes_says_of_similarities_that_scatter_as_the_temperature_claims():
    """Half of the objects are none of the concepts, with similarities around 0; of the others, one is around tau."""
    rng = np.random.default_rng(0)
    tau, count, concepts = 2.0, 20000, DIM
    true = rng.integers(0, concepts, count)
    none = rng.random(count) < 0.5
    z = rng.standard_normal((count, concepts))
    z[np.flatnonzero(~none), true[~none]] += tau
    answer = text(np.eye(concepts))  # similarity 0.3 on average, with a spread of 0.25
    found = 0.3 + 0.25 * z
    rows, known = naming.beliefs(found, answer, np.full((1, concepts), -math.log(concepts)))
    for low, high in ((0.0, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 1.0)):
        chosen = (known >= low) & (known < high)
        assert (~none[chosen]).mean() == pytest.approx(known[chosen].mean(), abs=0.03)
    certain = rows.max(axis=1) * known
    right = (rows.argmax(axis=1) == true) & ~none
    assert right[certain > 0.5].mean() == pytest.approx(certain[certain > 0.5].mean(), abs=0.03)


def test_commonness_by_hand():
    """Regions of 0.8 and 0.2: the first object 0.8 * 0.5 + 0.2 * 0.1, the second 0.2 * 0.9."""
    regions = [RegionPrior(name=name, phrases=[name], existence=share) for name, share in (("a", 0.8), ("b", 0.2))]
    held = np.array([[0.5, 0.0], [0.1, 0.9]], np.float32)
    assert naming.commonness(prior(["a", "b"], regions=regions, containment=held)) == pytest.approx([0.7, 0.3])


def test_boxes_decide_where_looks_do_not():
    """Two things that look like an oven and like a bed alike; the prior knows what size these are."""
    both = np.full(DIM, 0.0)
    both[:2] = 1.0
    sized = [
        ObjectPrior(name="oven", phrases=["an oven"], size_m=(0.6, 0.6, 0.9), size_spread=0.2, bottom_m=0.0),
        ObjectPrior(name="bed", phrases=["a bed"], size_m=(1.6, 1.2, 0.6), size_spread=0.2, bottom_m=0.0),
    ]
    frames = [sight(i, pose, [BED, OVEN]) for i, pose in enumerate(walk())]
    frames = [msgspec.structs.replace(f, embeddings=np.array([both, both], np.float16) / 2**0.5) for f in frames]
    positions, edges = place_grid(1)
    for entries, labels in ((None, ["", ""]), (sized, ["bed", "oven"])):
        known = prior(["kitchen", "bedroom"], **({"objects": entries} if entries else {}))
        run = Run().feed(place_delta(positions, edges), *frames, TICK, task(), known, TICK)
        assert sorted(item.label for item in run.objects.values()) == labels


def test_votes_by_hand():
    """The encoder: the first of two, if any, which is 0.6 likely. The detector: the second, with 2 of 3 votes."""
    votes = np.array([naming.said({"bed": 0.6, "stove": 0.3}, prior(["kitchen", "bedroom"])), [0.0, 0.0]])
    assert votes[0] == pytest.approx([0.0, 2 / 3])  # the prior's objects are oven and bed
    rows, known = naming.with_votes(np.array([[1.0, 0.0]] * 2), np.array([0.6, 0.6]), votes, trust=0.9)
    # of the belief, 0.9 * 2/3 = 0.6 is the detector's; the encoder has 0.4, of which 0.6 is for the first
    assert known == pytest.approx([0.6 + 0.4 * 0.6, 0.6])
    assert rows[0] == pytest.approx([0.24 / 0.84, 0.6 / 0.84]) and rows[1] == pytest.approx([1.0, 0.0])
    assert naming.said({}, prior(["kitchen"])).tolist() == [0.0, 0.0]


class Run:
    """One segmenter; text requests are answered with the basis vectors of regions, or of the oven and the bed."""

    def __init__(self, cfg=None):
        self.cfg = cfg or Config()
        self.runner = Runner(SERVICE, self.cfg, Identity(ROBOT, "i", 1), {TEXT: self.answer}, wire=True)
        self.state = self.runner.state
        self.deltas, self.objects = [], {}

    def answer(self, request):
        return text(EYE[: len(request.concepts)], space=request.space)

    def feed(self, *messages):
        for _, message in self.runner.feed(*messages):
            if isinstance(message, ObjectDelta):
                self.take(message)
        return self

    def take(self, delta):
        assert delta.revision == len(self.deltas)
        self.deltas.append(delta)
        for number in [*delta.removed_ids.tolist(), *delta.merged_ids[:, 0].tolist()]:
            del self.objects[number]
        for entry in delta.objects:
            self.objects[entry.id] = entry


def started(cfg=None, **kwargs):
    positions, edges = place_grid(1)
    frames = [sight(i, pose, [BED, OVEN], **kwargs) for i, pose in enumerate(walk())]
    return Run(cfg).feed(place_delta(positions, edges), *frames, TICK)


def test_objects_are_told_once_and_named_when_a_prior_comes():
    run = started()
    assert [item.label for item in run.objects.values()] == ["", ""] and run.deltas[0].prior_digest == ""
    run.feed(TICK, TICK)
    assert len(run.deltas) == 1
    run.feed(task(), prior(["kitchen", "bedroom"]), TICK, TICK)
    assert sorted(item.label for item in run.objects.values()) == ["bed", "oven"] and len(run.deltas) == 2
    assert run.deltas[1].prior_digest == run.state.aim.in_force.digest
    snapshot = SERVICE.answers[OBJECT_SNAPSHOT](run.state, SnapshotRequest(robot=ROBOT), run.cfg)
    assert snapshot.snapshot and snapshot.revision == 1
    assert {item.id: item for item in snapshot.objects} == run.objects


@pytest.mark.parametrize(("sought", "word"), [([], 0.0), (["bed", "oven"], 1.0), (["piano", "fish"], 0.0)])
def test_only_objects_that_were_sought_by_the_priors_names_answer_what_it_holds(sought, word):
    names = np.arange(len(sought), dtype=np.int16)
    fields = {"prompted": bool(sought), "sought": sought, "names": names}
    view = started(**fields).feed(task(), prior(["kitchen", "bedroom"]), TICK).state.objects.view
    assert isinstance(view, ObjectView) and len(view.ids) == 2
    assert np.allclose(view.concepts.sum(axis=1), 1.0)
    assert (view.words > 0.9).all()
    assert view.answers == pytest.approx([word, word], abs=0.1) and (view.answers > 0).all() == (word > 0)
    silent = Config(tracking=TrackingConfig(unprompted_weight=0.0))
    view = started(silent, **fields).feed(task(), prior(["kitchen", "bedroom"]), TICK).state.objects.view
    assert view.words == pytest.approx([word, word], abs=0.1)


def test_the_detectors_name_outweighs_the_encoders():
    """Encoded as bed and oven, found as oven and bed."""
    names = {"sought": ["bed", "oven"], "names": np.array([1, 0], np.int16)}
    encoded = started().feed(task(), prior(["kitchen", "bedroom"]), TICK).objects
    detected = started(prompted=True, **names).feed(task(), prior(["kitchen", "bedroom"]), TICK).objects
    assert [encoded[i].label for i in (0, 1)] == ["bed", "oven"]
    assert [detected[i].label for i in (0, 1)] == ["oven", "bed"]


def test_where_nothing_is_likely_enough_no_object_has_a_label_and_nothing_a_word():
    cfg = Config(tracking=TrackingConfig(label_least=1.0, unprompted_weight=0.0))
    positions, edges = place_grid(1)
    frames = [sight(i, pose, [BED, OVEN]) for i, pose in enumerate(walk())]
    run = Run(cfg).feed(place_delta(positions, edges), *frames, TICK, task(), prior(["kitchen", "bedroom"]), TICK, TICK)
    assert [item.label for item in run.objects.values()] == ["", ""]
    assert all(item.probability > 0.5 and 0 < item.known < 1 for item in run.objects.values())
    assert len(run.state.objects.view.ids) == 0


def test_a_pose_update_moves_what_was_told():
    run = started()
    before = dict(run.objects)
    shift = np.eye(4)
    shift[:3, 3] = (0.0, 6.0, 0.0)
    poses = np.array([shift @ pose for pose in walk()])
    update = PoseUpdate(
        robot=ROBOT, epoch=1, revision=0, stamp_ns=9, frame_ids=np.arange(len(poses)), world_from_camera=poses
    )
    run.feed(update, TICK)
    assert run.objects.keys() == before.keys()
    for number, item in run.objects.items():
        assert np.subtract(item.position_m, before[number].position_m) == pytest.approx((0, 6, 0), abs=0.2)


def test_detections_of_another_space_wait_until_it_is_in_force():
    run = started()
    there = dict(run.objects)
    run.feed(*[sight(i, pose, [OVEN], space="other/space") for i, pose in enumerate(walk())], TICK)
    assert run.objects == there
    renew(run.state.objects.tracks, "other/space", 99, run.cfg.tracking)
    assert [track.frames for track in run.state.objects.tracks.items.values()] == [8]


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match="shares"):
        msgspec.convert({"match_overlap": 2.0}, TrackingConfig)
