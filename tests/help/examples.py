"""One message of every type, with every field set to what it is not by default."""

import msgspec
import numpy as np

from prior_sg.schemas import (
    answers,
    features,
    foresight,
    frames,
    levels,
    markers,
    members,
    objects,
    places,
    priors,
    queries,
    regions,
    scene,
    status,
    succession,
)
from prior_sg.schemas.codec import M, Message

CAMERA = frames.Intrinsics(640, 480, 525.5, 526.5, 319.5, 239.5)
POSE = np.array([[0.0, -1, 0, 1.5], [1, 0, 0, -2.5], [0, 0, 1, 3.5], [0, 0, 0, 1]])


def f2(*values):
    return np.array(values, np.float16)


def f4(*values):
    return np.array(values, np.float32)


def i2(*values):
    return np.array(values, np.int16)


def i8(*values):
    return np.array(values, np.int64)


KEYFRAME = frames.Keyframe(
    robot="r",
    frame_id=7,
    stamp_ns=8,
    intrinsics=CAMERA,
    world_from_camera=POSE,
    color=b"c",
    depth=b"d",
    depth_scale_m=0.002,
    mask=b"m",
    space="s",
    origin_m=(512e3, 5.4e6, 312.0),
    camera="left",
)
TASK = priors.Task(robot="r", stamp_ns=2**60, environment="home", task="tidy up", regions=["kitchen", "Küche"])
LEVEL_PRIOR = levels.LevelPrior(
    name="zone",
    task="which zone?",
    entries=[levels.Entry(name="day zone", existence=0.75), levels.Entry(name="way", existence=0.25)],
    parents=f4([0.875, 0.125], [0.25, 0.75]),
    adjacency=f4([1.0, 0.5], [0.5, 1.0]),
)
LEVEL_NODE = levels.LevelNode(
    level="floor",
    id=3,
    label="floor 0",
    probability=0.75,
    member_ids=[2, 6],
    members="zone",
    area_m2=12.5,
    position_m=(1.0, 2.0, 0.5),
    parent_id=1,
)
PRIOR = priors.Prior(
    environment="home",
    task="tidy up",
    vocabulary=["kitchen", "hall"],
    regions=[
        priors.RegionPrior(
            name="kitchen",
            phrases=["a stove", "a sink"],
            existence=0.75,
            inclination_mean_rad=0.1,
            inclination_std_rad=0.3,
            query_radius_m=0.5,
            parent="day zone",
        ),
        priors.RegionPrior(
            name="hall",
            phrases=["a door"],
            existence=0.25,
            inclination_mean_rad=0.2,
            inclination_std_rad=0.4,
            query_radius_m=1.5,
            parent="way",
        ),
    ],
    objects=[
        priors.ObjectPrior(
            name="stove", phrases=["a stove"], size_m=(0.75, 0.5, 0.875), size_spread=0.25, bottom_m=0.125
        )
    ],
    containment=f4([0.9], [0.1]),
    adjacency=f4([1.0, 0.5], [0.5, 1.0]),
    provenance=priors.Provenance(
        source="model",
        detail="d",
        parent_digest="p",
        note="n",
        question="q",
        prompts="3",
        samples=2,
        made_by="g",
        made_ns=3,
        signer="s",
        signature="00ff",
        root_digest="o",
        contributors=["r", "s"],
    ),
    spread=priors.Spread(
        existence=f4(0.1, 0.2),
        containment=f4([0.2], [0.3]),
        adjacency=f4([0.3, 0.4], [0.4, 0.3]),
        support=f4(1.0, 0.5),
    ),
    levels=[LEVEL_PRIOR],
    tested=priors.Counts(regions=f4(2.0, 0.5), looks=0.5),
)
EVIDENCE = priors.PriorEvidence(
    robot="r",
    epoch=1,
    stamp_ns=2,
    prior_digest="d",
    environment="home",
    task="tidy up",
    vocabulary=["kitchen"],
    regions=["kitchen", "hall"],
    objects=["stove"],
    places=f4(3.0, 2.5),
    instances=f4(1.0, 2.0),
    holding=f4([1.0], [0.5]),
    pairs=f4([2.0, 1.0], [1.0, 2.0]),
    touching=f4([1.0, 0.5], [0.5, 1.0]),
    sizes=f4(3.0, 2.0),
    looks=f4([-0.5, -1.5], [-2.0, -0.25]),
    contents=f4([1.0], [0.25]),
    links=np.array([[0, 1]], np.int32),
)
MEMBER = members.MapMember(robot="r1", session=1, id=7)
REGION = regions.Region(
    id=4,
    label="kitchen",
    place_count=1,
    probability=0.5,
    position_m=(1.0, 2.0, 3.0),
    area_m2=4.0,
    unknown=0.5,
    predicted=True,
    hull_m=[(0.25, 0.5), (1.0, 0.5), (0.5, 1.0)],
    neighbour_ids=[5],
    transitions=[regions.Transition(region=5, edge=(1, 2), position_m=(0.5, 0.25, 1.0), clearance_m=0.4, door=True)],
    object_ids=[9],
    parent="day zone",
    members=[MEMBER],
)
OBJECT = objects.SceneObject(
    id=4,
    label="stove",
    probability=0.5,
    known=0.75,
    position_m=(1.0, 2.0, 0.5),
    min_m=(0.5, 1.5, 0.125),
    max_m=(1.5, 2.5, 1.0),
    frames=3,
    members=[MEMBER],
)
MARKER = markers.SceneMarker(
    dictionary="apriltag_36h11",
    id=7,
    size_m=0.25,
    position_m=(1.0, 2.0, 1.5),
    quaternion_xyzw=(0.5, 0.5, 0.5, 0.5),
    frames=3,
    doubt="it has been seen at 2 spots",
)
SPOT = queries.Spot(point_m=(1.0, 2.0, 3.0), what="region", id=4, dictionary="4x4_50", label="hall", here=True)
FORESIGHT = foresight.Foresight(
    openings=[
        foresight.Opening(
            place_id=2,
            position_m=(4.0, 5.0, 6.0),
            beyond_m=(5.0, 5.0, 6.0),
            width_m=0.875,
            region=4,
            same=0.25,
            labels=[
                foresight.ForeseenLabel(
                    label="hall", next=0.5, within=0.75, toward=0.625, adjacency=0.875, existence=0.25, found=1, met=2
                )
            ],
        )
    ],
    missing=[foresight.MissingLabel(label="hall", probability=0.75, found=1)],
    steps=3,
    look_m=2.5,
    elsewhere_m=40.5,
)
QUESTIONS = [
    queries.ById(what="region", id=4),
    queries.ByLabel(label="oven", what="object", limit=5),
    queries.InBox(min_m=(0.0, 1.0, 2.0), max_m=(3.0, 4.0, 5.0), what="place", label="hall", limit=6),
    queries.InRadius(point_m=(1.0, 2.0, 3.0), radius_m=1.5, what="object", label="stove", limit=7),
    queries.Nearest(point_m=(1.0, 2.0, 3.0), what="region", label="hall", limit=3),
    queries.NeighboursOf(what="place", id=1),
    queries.ObjectsInRegions(object_label="stove", region_label="kitchen", limit=8),
    queries.RouteBetween(start=SPOT, goal=SPOT, clearance_m=0.25),
    queries.ChangedSince(revision=3),
    queries.BeliefsOf(region=4, limit=2),
    queries.WordsInUse(),
    queries.AnswersTo(text="eat", regions={"kitchen": 0.75}, objects={"stove": 0.5}, what="region", limit=4),
    queries.NodesOf(level="zone", label="ward", id=2, region=4, limit=3),
    queries.WhereToLook(label="kitchen", start=SPOT, clearance_m=0.25, limit=3),
    queries.WhatIsMissing(limit=5),
    queries.MarkersOf(id=7, dictionary="apriltag_36h11", limit=5),
]
THING = answers.Thing(
    what="object",
    id=4,
    label="stove",
    position_m=(1.0, 2.0, 3.0),
    probability=0.5,
    region=6,
    predicted=True,
    distance_m=1.5,
    score=0.25,
)
BELIEF = answers.LabelBelief(label="kitchen", probability=0.75)
ANSWERS = [
    answers.Things(things=[THING], total=2, nearest_labels=["hall"], reason="r"),
    answers.Details(
        thing=THING,
        place=answers.PlaceDetails(radius_m=0.5, beliefs=[BELIEF], unknown=0.25, frontier_m2=1.5),
        region=REGION,
        object=OBJECT,
        reason="r",
    ),
    answers.Neighbourhood(
        neighbours=[answers.Neighbour(thing=THING, clearance_m=0.5, length_m=1.5, ways=REGION.transitions)], reason="r"
    ),
    answers.Route(
        found=True,
        reason="r",
        start=THING,
        goal=THING,
        place_ids=[1, 2],
        waypoints_m=[(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)],
        length_m=2.5,
        clearance_m=0.25,
        regions=[THING],
        start_gap_m=0.5,
        goal_gap_m=0.75,
    ),
    answers.Difference(
        since_revision=3,
        appeared=[THING],
        gone=[THING],
        renamed=[answers.Renamed(thing=THING, former_label="hall")],
        places_appeared=1,
        places_gone=2,
        places_relabelled=3,
        task_before="t",
        reason="r",
    ),
    answers.RegionBeliefs(
        thing=THING, beliefs=[BELIEF], unknown=0.25, predicted_share=0.5, places=3, reason="r", total=2
    ),
    answers.Words(
        environment="home",
        task="tidy up",
        space="s",
        prior_digest="d",
        labels=["kitchen", "hall"],
        regions={"kitchen": 1},
        objects={"stove": 2},
        merged_of=["r1", "r2"],
    ),
    answers.Ranking(things=[THING], note="n", reason="r", total=2),
    answers.Nodes(nodes=[answers.NodeWithRegions(node=LEVEL_NODE, regions=[THING])], total=2, reason="r"),
    answers.Outlook(
        label="hall",
        prospects=[
            answers.Prospect(
                opening=FORESIGHT.openings[0],
                probability=0.75,
                expected_m=12.5,
                way_m=3.5,
                toward=0.5,
                per_metre=0.125,
            )
        ],
        probability=0.875,
        route=answers.Route(
            found=True,
            reason="r",
            start=THING,
            goal=THING,
            place_ids=[1, 2],
            waypoints_m=[(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)],
            length_m=2.5,
            clearance_m=0.25,
            regions=[THING],
            start_gap_m=0.5,
            goal_gap_m=0.75,
        ),
        found=[THING],
        reason="r",
        total=2,
        look_m=1.5,
    ),
    answers.Missing(labels=FORESIGHT.missing, openings=2, reason="r", total=2),
    answers.Markers(markers=[answers.MarkerInRegion(marker=MARKER, region=THING)], total=2, reason="r"),
]

EXAMPLES: list[Message] = [
    KEYFRAME,
    frames.PoseUpdate(
        robot="r", epoch=1, revision=2, stamp_ns=3, frame_ids=i8(4, 5), world_from_camera=np.stack([POSE, POSE])
    ),
    frames.CameraState(robot="r", stamp_ns=1, world_from_camera=POSE),
    frames.IngestState(
        robot="r",
        stamp_ns=1,
        frames_read=2,
        frames_total=3,
        keyframes=4,
        encoded=5,
        rejected=6,
        finished=True,
        skipped=7,
        losses=[status.Loss(what="w", reason="r", count=1, example="e")],
    ),
    frames.ArchiveRequest(robot="r", first_frame_id=1, end_frame_id=2, limit=3),
    frames.ArchiveReply(robot="r", oldest_frame_id=7, keyframes=[KEYFRAME]),
    features.Pyramid(
        robot="r",
        frame_id=1,
        stamp_ns=2,
        space="s",
        worker="w",
        intrinsics=CAMERA,
        world_from_camera=POSE,
        centers_px=f4([10, 20]),
        sigmas_px=f4(112),
        layers=np.array([1], np.uint8),
        depths_m=f4(2.5),
        embeddings=f2([0.6, 0.8]),
        surface_m=f4([1, 2, 3], [4, 5, 6]),
        crops_total=5,
    ),
    features.Backfill(robot="r", space="s", frame_ids=i8(1, 2), settled=True, epoch=3, number=4),
    features.TextRequest(space="s", concepts=[["a", "b"], ["c"]]),
    features.TextEmbeddings(
        space="s",
        embeddings=f4([0.6, 0.8]),
        background_mean=f4(0.1),
        background_std=f4(0.2),
        temperature=0.5,
        null_score=-1.5,
    ),
    places.PlaceDelta(
        robot="r",
        epoch=3,
        revision=4,
        stamp_ns=5,
        frame_id=6,
        snapshot=True,
        place_ids=i8(1, 2),
        positions_m=f4([1, 2, 3], [4, 5, 6]),
        radii_m=f4(0.5, 0.75),
        basis_points=i2(2, 3),
        removed_ids=i8(9),
        merged_ids=i8([8, 1]),
        edges=i8([1, 2]),
        clearances_m=f4(0.4),
        removed_edges=i8([2, 9]),
        camera_m=(1.0, 2.0, 3.0),
        event="late",
        past_frame_ids=i8(6),
        past_cameras_m=f4([1, 2, 3]),
        frontier_ids=i8(2),
        frontier_directions=f4([0, 0, 1]),
        frontier_areas_m2=f4(0.5),
        surface_ids=i8(1),
        ellipses=f4([2, 1, 0.5]),
        hull_counts=i8(3),
        hulls_m=f4([0, 0], [1, 0], [0, 1]),
        origin_m=(512e3, 5.4e6, 312.0),
        merged_of=["r1", "r2"],
    ),
    places.SnapshotRequest(robot="r"),
    places.MapRequest(robot="r"),
    places.VoxelMap(robot="r", voxel_m=0.1, free=i2([1, -2, 3], [4, 5, 6]), occupied=i2([7, 8, 9])),
    TASK,
    priors.TaskRequest(robot="r"),
    priors.TaskInForce(robot="r", task=TASK),
    PRIOR.spread,
    LEVEL_PRIOR,
    PRIOR.tested,
    PRIOR,
    priors.PriorRequest(digest="d", environment="home", task="tidy up", regions=["kitchen"]),
    priors.PriorList(priors=[PRIOR], reason="r", pending=True),
    priors.PriorClaim(question="q", holder="g", state="gave up"),
    EVIDENCE,
    priors.PriorRevision(environment="home", task="tidy up", regions=["kitchen"], by_model=True),
    priors.ModelRequest(
        conversation="c",
        turn=1,
        messages=[("system", "be brief"), ("user", "hello")],
        schema="{}",
        schema_name="n",
        max_tokens=5,
    ),
    priors.ModelReply(
        conversation="c", turn=1, text="x", failure="f", reason="r", attempts=2, tokens_in=3, tokens_out=4
    ),
    priors.Recall(question="q", environment="home", task="tidy up", regions=["kitchen"]),
    priors.Recalled(question="q", preferred=PRIOR, exact=PRIOR, newest=PRIOR, root=PRIOR, evidence=[EVIDENCE]),
    priors.Keep(prior=PRIOR, root=PRIOR, preferred=True, own=True, question="q", evidence=EVIDENCE),
    priors.Kept(prior=PRIOR, question="q", verdict="v"),
    regions.RegionDelta(
        robot="r",
        epoch=1,
        revision=2,
        stamp_ns=3,
        prior_digest="d",
        environment="home",
        task="tidy up",
        space="s",
        snapshot=True,
        labels=["kitchen", "hall"],
        regions=[REGION],
        removed_ids=i8(3),
        place_ids=i8(1),
        place_regions=i8(4),
        posteriors=f2([0.75, 0.25]),
        unknown=f2(0.25),
        removed_place_ids=i8(8),
        energy=-1.5,
        predicted_ids=i8(1),
        events=[regions.RegionEvent(kind="split", region=4, label="kitchen", other=5, former_label="hall")],
        removed_nodes=[("zone", 5)],
        nodes=[LEVEL_NODE],
        foresight=FORESIGHT,
    ),
    regions.PosteriorRequest(robot="r", place_id=1),
    regions.PosteriorReply(
        robot="r",
        place_id=1,
        found=True,
        label="kitchen",
        labels=["kitchen", "hall"],
        posterior=[0.75, 0.25],
        unary=[0.5, 1.5],
        votes=[regions.ExpertVote(expert="visual", confidence=0.5, weight=2.0, log_probabilities=[-0.25, -1.5])],
        frames=2,
        trust=1.5,
        position_m=(1.0, 2.0, 3.0),
        region=4,
        pull=[0.25, 0.5],
        neighbours=[regions.NeighbourPull(place_id=2, label="hall", weight=0.5)],
        unknown=0.25,
        predicted=True,
        temperature=2.0,
        inclination_rad=0.125,
    ),
    objects.Detections(
        robot="r",
        frame_id=1,
        stamp_ns=2,
        space="s",
        detector="segments",
        prompted=True,
        worker="w",
        intrinsics=CAMERA,
        world_from_camera=POSE,
        boxes_px=f4([10, 20, 50, 60]),
        scores=f4(0.5),
        embeddings=f2([0.6, 0.8]),
        point_counts=np.array([2], np.int32),
        points_camera_m=f2([0, 0, 1], [0.5, 0, 1]),
        surface_m=f2([1, 2, 3], [4, 5, 6]),
        sought=["sink", "stove"],
        names=i2(1),
        marker_dictionary="apriltag_36h11",
        marker_size_m=0.25,
        marker_ids=np.array([7], np.int32),
        marker_sides_px=f4(40),
        camera_from_marker=POSE[None],
    ),
    objects.ObjectDelta(
        robot="r",
        epoch=1,
        revision=2,
        stamp_ns=3,
        prior_digest="d",
        snapshot=True,
        objects=[OBJECT],
        removed_ids=i8(7),
        merged_ids=i8([5, 4]),
        markers=[MARKER],
    ),
    scene.SceneRevision(robot="r", epoch=1, revision=2, stamp_ns=3, places=4, edges=5, regions=6),
    scene.SceneRequest(robot="r", revision=7, stamp_ns=8),
    scene.HistoryRequest(robot="r", limit=5, before=9),
    scene.RevisionList(
        robot="r",
        revisions=[
            scene.StoredRevision(
                revision=7, session=1, kind="place", stamp_ns=8, places=4, edges=5, regions=6, objects=3
            )
        ],
    ),
    scene.Scene(
        robot="r",
        stamp_ns=1,
        environment="home",
        task="tidy up",
        prior_digest="d",
        space="s",
        labels=["kitchen", "hall"],
        regions=[REGION],
        place_ids=i8(1, 2),
        positions_m=f4([1, 2, 3], [4, 5, 6]),
        radii_m=f4(0.5, 0.75),
        basis_points=i2(2, 3),
        place_regions=i8(4, regions.NO_REGION),
        posteriors=f2([0.75, 0.25], [0.5, 0.5]),
        unknown=f2(0.25, 1),
        edges=i8([1, 2]),
        clearances_m=f4(0.4),
        trajectory=f4([1, 2, 3]),
        predicted_ids=i8(2),
        objects=[OBJECT],
        frontier_ids=i8(2),
        frontier_directions=f4([0, 0, 1]),
        frontier_areas_m2=f4(0.5),
        surface_ids=i8(1),
        ellipses=f4([2, 1, 0.5]),
        hull_counts=i8(3),
        hulls_m=f4([0, 0], [1, 0], [0, 1]),
        origin_m=(512e3, 5.4e6, 312.0),
        merged_of=["r1", "r2"],
        revision=9,
        nodes=[LEVEL_NODE],
        foresight=FORESIGHT,
        markers=[MARKER],
    ),
    queries.SceneQuery(robot="r", questions=QUESTIONS),
    queries.SceneAnswer(robot="r", revision=2, stamp_ns=3, answers=ANSWERS),
    status.Consumed(
        robot="r",
        service="s",
        instance="i",
        order=1,
        topic="T",
        frame_id=2,
        writer="w",
        sequence=3,
        inline=b"x",
        key="k",
    ),
    status.Started(
        robot="r", service="s", instance="i", epoch=1, config=b"{}", reads=["KEYFRAME"], versions={"Keyframe": 2}
    ),
    status.Tick(stamp_ns=1),
    status.JobDone(topic="T", frame_id=1, worker="w", attempts=2, error="e"),
    status.EpochRequest(robot="r", topic="T", keeper="k"),
    status.EpochKnown(robot="r", topic="T", epoch=1, revision=2),
    status.StatusRequest(frame_id=1, since_ns=2),
    status.ServiceStatus(
        service="s",
        instance="i",
        robot="r",
        pid=1,
        uptime_s=2.5,
        backlog=3,
        busy_share=0.5,
        step_ms_p50=4.5,
        step_ms_p99=5.5,
        resident_mb=6.5,
        waiting_for=["PRIORS"],
        topics=[
            status.TopicCount(
                topic="T",
                received=1,
                consumed=2,
                published=3,
                malformed=4,
                skipped=5,
                duplicate=6,
                missed=7,
                limited=9,
                last_age_ms=8.5,
            )
        ],
        losses=[status.Loss(what="w", reason="r", count=1, example="e")],
        step_s=7.5,
        step_compiling_s=6.5,
        clock_ns=8,
        release="1",
        cpu_s=9.5,
        oldest_wait_s=10.5,
        step_counts=[1, 2],
        step_sum_s=11.5,
        pools=[status.PoolCount(topic="T", waiting=1, running=2, oldest_wait_s=3.5, workers={"w": 4})],
        figures={"f": 12.5},
        passages=[
            status.Passage(
                robot="r",
                topic="T",
                frame_id=1,
                revision=2,
                stamp_ns=3,
                sent_ns=4,
                received_ns=5,
                began_ns=6,
                ended_ns=7,
                writer="w",
                traceparent="t",
                published={"P": 8},
                worker="v",
                attempts=9,
                fault="f",
            )
        ],
    ),
]


def of(kind: type[M]) -> M:
    """The example of a type."""
    return next(message for message in EXAMPLES if isinstance(message, kind))


EXAMPLES += [
    succession.YieldRequest(successor="i"),
    BEQUEST := succession.Bequest(
        robot="r",
        service="s",
        instance="i",
        places=of(places.PlaceDelta),
        regions=of(regions.RegionDelta),
        objects=of(objects.ObjectDelta),
        next_ids={"places": 1},
    ),
    succession.Succession(predecessor="i"),
    succession.TakesOver(bequest=BEQUEST),
    succession.EvidenceRequest(robot="r", after_frame_id=1),
    succession.Evidence(
        robot="r",
        space="s",
        last_frame_id=1,
        pyramids=[of(features.Pyramid)],
        detections=[of(objects.Detections)],
    ),
    succession.SwapRequest(settings=["segmenter.beta=3"], config="c"),
    succession.Swapped(successor="i", error="e"),
]


def unset_fields(value, path=""):
    """Fields of a struct, and of those inside it, that are empty, zero or as they are by default."""
    if isinstance(value, msgspec.Struct):
        for field in msgspec.structs.fields(value):
            here, held = f"{path}.{field.name}", getattr(value, field.name)
            if _equal(held, _default(field)) or _empty(held):
                yield here
            yield from unset_fields(held, here)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from unset_fields(item, f"{path}[]")


def _default(field):
    if field.default_factory is not msgspec.NODEFAULT:
        return field.default_factory()
    return field.default


def _equal(one, other):
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return np.array_equal(one, other)
    return type(one) is type(other) and one == other


def _empty(value):
    if isinstance(value, np.ndarray):
        return not value.any()
    return value is None or value in (0, "", b"", False) or value in ([], (), {})
