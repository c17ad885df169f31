"""Clocks and counts that jump: whatever one of them does, a stream loses a few frames, says which, and time rises."""

import asyncio

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.topics import INGEST_STATE, KEYFRAME, POSE_UPDATE
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import BadFrame, Correction, EndOfSource, RawFrame
from prior_sg.services.ingest.service import SERVICE, Pace
from prior_sg.services.runtime.runner import Runner

SECOND = 10**9
CFG = Config(every_frame=True)


def frame(number, stamp_s, x=0.0):
    world_from_camera = np.eye(4)
    world_from_camera[0, 3] = x
    return RawFrame(
        frame_id=number,
        stamp_ns=round(stamp_s * SECOND),
        intrinsics=Intrinsics(4, 4, 4.0, 4.0, 1.5, 1.5),
        world_from_camera=world_from_camera,
        color=b"",
        depth=b"",
        depth_scale_m=0.001,
        index=number,
        total=0,
    )


def run(frames, end=True):
    """Keyframes and the last report of progress."""
    with Runner(SERVICE, CFG) as ingest:
        outputs = ingest.feed(*frames, *([EndOfSource()] if end else []))
    keyframes = [message for topic, message in outputs if topic is KEYFRAME]
    stamps, numbers = ([getattr(k, name) for k in keyframes] for name in ("stamp_ns", "frame_id"))
    assert all(np.diff(stamps) > 0) and all(np.diff(numbers) > 0), "readers count on both to rise"
    state = [message for topic, message in outputs if topic is INGEST_STATE][-1]
    assert state.frames_read == len(frames) == state.keyframes + state.rejected
    refused = sum(loss.count for loss in state.losses if loss.what == "frames refused")
    assert refused == state.rejected, "every frame lost is told"
    return keyframes, state


@settings(max_examples=300)
@given(
    count=st.integers(2, 40),
    at=st.integers(1, 39),
    by_s=st.one_of(st.floats(-1e9, 1e9), st.floats(-3, 3), st.floats(-100, 100)),
    rate=st.sampled_from((1.0, 10.0, 30.0)),
)
def test_one_jump_of_the_clock_anywhere_costs_three_frames_at_most(count, at, by_s, rate):
    frames = [frame(i, 2e9 + i / rate + (by_s if i >= at else 0), x=0.01 * i) for i in range(count)]
    keyframes, _ = run(frames)
    assert len(keyframes) >= count - 3


@settings(max_examples=200)
@given(count=st.integers(1, 30), at=st.integers(0, 29), by_s=st.floats(-1e9, 1e9))
def test_a_single_wrong_stamp_does_not_cost_the_stream(count, at, by_s):
    frames = [frame(i, 2e9 + i / 10 + (by_s if i == at else 0)) for i in range(count)]
    keyframes, _ = run(frames)
    assert len(keyframes) >= count - 3


@pytest.mark.parametrize("by_s", [-3600, 3600, 1e8])
def test_a_single_wrong_stamp_costs_one_frame(by_s):
    keyframes, state = run([frame(i, i / 10 + 1e9 + (by_s if i == 6 else 0)) for i in range(15)])
    assert len(keyframes) == 14 and state.rejected == 1
    assert state.losses[0].example.startswith("frame 6: its stamp is ")


def test_a_clock_set_back_costs_nothing_and_is_told():
    keyframes, state = run([frame(i, 7200 + i / 10 - (3600 if i >= 6 else 0)) for i in range(15)])
    assert len(keyframes) == 15
    assert np.allclose(np.diff([k.stamp_ns for k in keyframes]), SECOND / 10), "time goes on at the pace of the source"
    (loss,) = state.losses
    assert (loss.what, loss.reason, loss.count) == ("clock jumps", "believed again", 1)
    assert loss.example == "the clock jumped by -3599.900 s at frame 6"


def test_two_recordings_joined_are_one_stream():
    once = [frame(i, i / 10) for i in range(10)]
    keyframes, state = run([*once, *once])
    assert [k.frame_id for k in keyframes] == list(range(20))
    assert (
        state.losses[0].example == "the clock jumped by -0.900 s at frame 0 and the numbers began again with 0 after 9"
    )


def test_corrections_name_frames_as_the_source_numbers_them_now():
    once = [frame(i, i / 10) for i in range(4)]
    correction = Correction(stamp_ns=1, frame_ids=np.array([0, 3]), world_from_camera=np.stack([np.eye(4)] * 2))
    with Runner(SERVICE, CFG) as ingest:
        outputs = ingest.feed(*once, *once, correction)
    (update,) = [message for topic, message in outputs if topic is POSE_UPDATE]
    assert update.frame_ids.tolist() == [4, 7]


def test_a_pause_is_kept():
    keyframes, _ = run([frame(i, i / 10 + (1800 if i >= 5 else 0)) for i in range(10)])
    assert len(keyframes) == 10 and keyframes[5].stamp_ns == round(1800.5 * SECOND)


def test_slow_streams_have_no_pauses():
    keyframes, state = run([frame(i, 300 * i) for i in range(5)])
    assert len(keyframes) == 5 and not state.losses


def test_a_clock_that_stands_still_is_not_believed(caplog):
    keyframes, state = run([frame(i, 5) for i in range(9)])
    assert len(keyframes) == 1 and state.losses[0].count == 8
    assert [record.message for record in caplog.records] == ["frame refused"] * 8


def test_frames_held_back_count_as_refused_until_they_are_believed():
    frames = [frame(0, 10), frame(1, 11), frame(2, 2), frame(3, 3)]
    _, state = run(frames, end=False)
    assert (state.rejected, state.losses[0].reason, state.losses[0].count) == (2, "their stamps go back", 2)
    _, state = run([*frames, frame(4, 4)], end=False)
    assert state.rejected == 0 and [loss.what for loss in state.losses] == ["clock jumps"]


def test_unreadable_frames_are_told_by_reason():
    bad = [BadFrame(frame_id=i, reason=f"color/{i:06d}.png is damaged", index=i, total=4) for i in (2, 3)]
    with Runner(SERVICE, CFG) as ingest:
        state = ingest.feed(frame(0, 0), *bad)[-1][1]
    (loss,) = state.losses
    assert (loss.what, loss.count, loss.reason) == ("frames unreadable", 2, "color/….png is damaged")
    assert loss.example == "frame 2: color/000002.png is damaged"


def test_pace_goes_on_after_a_jump_of_the_clock():
    async def waits_s(stamps_s):
        loop, pace, waited = asyncio.get_running_loop(), Pace(100.0), []
        for number, stamp_s in enumerate(stamps_s):
            began_s = loop.time()
            await asyncio.wait_for(pace.until_due(frame(number, stamp_s)), 5)
            waited.append(loop.time() - began_s)
        return waited

    waited = asyncio.run(waits_s([0, 10, 1e9, 1e9 + 10, 50, 60]))
    assert [wait > 0.05 for wait in waited] == [False, True, False, True, False, True]
