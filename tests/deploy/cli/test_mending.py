"""What a run says at its end about what it could not use, and when it maps nothing."""

from types import SimpleNamespace

import numpy as np
import pytest

from prior_sg.deploy.cli.mending import DEPTH_USELESS, NothingMappedError, check_mapped, mend
from prior_sg.deploy.running.job import Counts, Result
from prior_sg.deploy.running.recorder import Settling
from prior_sg.schemas.frames import IngestState
from prior_sg.schemas.status import Loss
from prior_sg.schemas.topics import KEYFRAME, PLACE_DELTA, PYRAMID, REGION_DELTA

BACK = Loss(
    what="frames refused",
    reason="their stamps go back",
    count=9,
    example="frame 6: its stamp is 3600.000 s before the previous frame's",
)


def result(losses=(), places=0, keyframes=()):
    ingest = IngestState(
        robot="r", stamp_ns=0, frames_read=15, frames_total=15, keyframes=0, encoded=0, rejected=9, finished=True
    )
    scene = SimpleNamespace(place_ids=np.zeros(places, np.int64))
    counts = Counts(keyframes=set(keyframes), ingest=ingest)
    return Result(scene, None, None, counts, 1.0, None, list(losses))


def test_a_loss_is_told_in_one_line():
    assert result([BACK]).loss_lines == [
        "9 of 15 frames refused: their stamps go back (frame 6: its stamp is 3600.000 s before the previous frame's)"
    ]


def test_a_run_without_a_map_fails_with_the_top_reason_and_what_to_do():
    with pytest.raises(NothingMappedError) as error:
        check_mapped(result([BACK]), "home")
    assert str(error.value).startswith("nothing was mapped: 9 of 15 frames refused: their stamps go back (frame 6")
    assert "--rate" in str(error.value) and "`prior-sg check home` says more" in str(error.value)


def test_a_map_with_losses_is_a_map():
    check_mapped(result([BACK], places=3), "home")


@pytest.mark.parametrize(("keyframes", "why"), [((), "no frame of the source was read"), ((1, 2), DEPTH_USELESS)])
def test_a_run_without_a_map_and_without_losses_fails_too(keyframes, why):
    with pytest.raises(NothingMappedError, match=why):
        check_mapped(result(keyframes=keyframes), "home")


def test_what_mends_is_named_for_each_kind():
    assert "--origin" in mend([Loss(what="w", reason="its camera is … m from the origin", count=1, example="")])
    assert "--intrinsics" in mend([Loss(what="w", reason="the principal point, x = …", count=1, example="")])
    assert mend([Loss(what="w", reason="something new", count=1, example="")]) == ""


def test_a_source_of_which_nothing_is_published_settles_at_once():
    settling = Settling((KEYFRAME, PLACE_DELTA, PYRAMID, REGION_DELTA))
    settling.changed_s -= 2.0
    assert settling.settled(1.5)
