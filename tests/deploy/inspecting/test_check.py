"""`prior-sg check` on small recordings: a good one, and ones with one thing wrong."""

import io
import json
import re

import cv2
import numpy as np
import pytest
from rich.console import Console

from prior_sg.deploy.cli import check as command
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.inspecting.beside import truth_beside
from prior_sg.deploy.inspecting.check import check, kind_of, look
from prior_sg.deploy.inspecting.following import Following
from prior_sg.services.geometry import quaternion_of
from prior_sg.services.ingest.core.selection import Config
from prior_sg.services.ingest.sources import SourceError, open_source
from prior_sg.services.place_graph.core.config import Config as Mapping
from tests.help import room

HEADER = "frame,stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw"
POSES = room.walk(12)


def camera_json(**changes) -> str:
    camera = room.CAMERA
    names = {"width": camera.width_px, "height": camera.height_px, "fx": camera.fx_px, "fy": camera.fy_px}
    return json.dumps(names | {"cx": camera.cx_px, "cy": camera.cy_px, "depth_scale_m": 0.001} | changes)


@pytest.fixture
def folder(tmp_path):
    """A good dataset folder."""
    path = tmp_path / "home [2]"
    for name in ("color", "depth"):
        (path / name).mkdir(parents=True)
    (path / "camera.json").write_text(camera_json())
    for i, pose in enumerate(POSES):
        cv2.imwrite(str(path / f"color/{i:06d}.png"), room.color_of(pose))
        cv2.imwrite(str(path / f"depth/{i:06d}.png"), np.rint(room.depth_of(pose) * 1000).astype(np.uint16))
    write_poses(path, POSES)
    return path


def write_poses(path, poses, order=(0, 1, 2, 3), stamps_ns=None):
    rows = [HEADER]
    for i, pose in enumerate(poses):
        stamp = 300_000_000 * i if stamps_ns is None else stamps_ns[i]
        numbers = [*pose[:3, 3], *quaternion_of(pose)[list(order)]]
        rows.append(",".join([str(i), str(stamp), *(f"{number:.9f}" for number in numbers)]))
    (path / "trajectory.csv").write_text("\n".join(rows) + "\n")


def checked(path, capsys, *options) -> tuple[int, dict]:
    status = main(["check", str(path), "--json", *options])
    return status, json.loads(capsys.readouterr().out)


def mends(report: dict) -> list[str]:
    return [finding["mend"] for finding in report["findings"] if finding["verdict"] == "problem"]


def test_a_good_recording(folder, capsys):
    status, report = checked(folder, capsys)
    assert status == 0
    assert not mends(report)
    assert report["layout"] == "dataset"
    topics = {finding["topic"] for finding in report["findings"]}
    assert {"layout", "frames", "stamps", "motion", "intrinsics", "depth", "poses", "up", "floor"} <= topics


@pytest.mark.parametrize(
    ("poses", "order", "options"),
    [
        ([np.linalg.inv(pose) for pose in POSES], (0, 1, 2, 3), ["--poses", "camera_from_world"]),
        (POSES, (3, 0, 1, 2), ["--quaternion", "wxyz"]),
        ([pose @ np.diag((1.0, -1, -1, 1)) for pose in POSES], (0, 1, 2, 3), ["--axes", "opengl"]),
    ],
)
def test_the_option_that_is_named_mends(folder, capsys, poses, order, options):
    write_poses(folder, poses, order)
    status, report = checked(folder, capsys)
    assert status == 1
    assert mends(report) == [" ".join(options)]
    assert checked(folder, capsys, *options)[0] == 0


def test_up_is_named_and_mends(folder, capsys):
    yup = np.array(((1.0, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)))
    write_poses(folder, [yup @ pose for pose in POSES])
    assert mends(checked(folder, capsys)[1]) == ["--up 0,1,0"]
    assert checked(folder, capsys, "--up", "0,1,0")[0] == 0


def test_keyframes_that_the_place_graph_will_refuse_for_their_speed_are_a_problem(folder, capsys):
    """4 m each 0.8 s: ingest believes 10 m/s, the place graph 3 m/s and 1 m more. Not those of a drive half as far."""
    drive = [pose.copy() for pose in POSES]
    for number, pose in enumerate(drive):
        pose[:3, 3] += (4.0 * number, 0.0, 0.0)
    stamps_ns = [800_000_000 * number for number in range(len(drive))]
    write_poses(folder, drive, stamps_ns=stamps_ns)

    def speed(*options) -> list[dict]:
        return [found for found in checked(folder, capsys, *options)[1]["findings"] if found["topic"] == "speed"]

    (found,) = speed()
    assert "will refuse about 11 of 12 keyframes" in found["text"] and "it believes 3" in found["text"]
    believes = re.search(r"--set (place_graph\.max_speed_m_s=\d+)", found["mend"])[1]
    assert speed("--set", believes) == speed("--set", "place_graph.preset=outdoor") == []
    assert main(["check", str(folder)]) == 1
    last = "".join(row.split("│")[4] for row in capsys.readouterr().out.splitlines() if row.startswith("│"))
    assert "".join(found["mend"].split()) in "".join(last.split())  # in whole, also where a column is narrow
    for number, pose in enumerate(drive):
        pose[0, 3] -= 2.0 * number
    write_poses(folder, drive, stamps_ns=stamps_ns)
    assert speed() == []


def test_what_cannot_be_opened_is_one_problem(folder, capsys):
    (folder / "camera.json").write_text("{")
    status, report = checked(folder, capsys)
    assert status == 1
    assert report["findings"][0]["hopeless"]


def test_the_table_prints_names_as_they_are(folder, capsys):
    assert main(["check", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "home [2]" in " ".join(printed.split())  # the title may be wrapped
    assert "no problems" in printed


def test_the_brief_check_says_one_line_of_a_good_recording(folder):
    printed = io.StringIO()
    report = command.before_start(str(folder), Config(), Console(file=printed, width=200))
    assert printed.getvalue().count("\n") == 1
    assert "12 frames, 96 x 72 pixels, 3.33 Hz, depth" in printed.getvalue()
    assert report.seconds < 5


def test_the_brief_check_names_problems_and_goes_on(folder):
    write_poses(folder, [np.linalg.inv(pose) for pose in POSES])
    printed = io.StringIO()
    command.before_start(str(folder), Config(), Console(file=printed, width=300))
    assert "--poses camera_from_world" in printed.getvalue()


def test_nothing_starts_when_no_map_can_come(folder):
    for file in (folder / "depth").iterdir():
        file.write_bytes(b"not an image")
    with pytest.raises((command.HopelessSource, SourceError)):
        command.before_start(str(folder), Config(), Console(file=io.StringIO()))


def test_a_depth_unit_wrong_by_a_thousand_stops_the_run_before_it_starts(folder, capsys, tmp_path):
    (folder / "camera.json").write_text(camera_json(depth_scale_m=1.0))
    run = ["run", str(folder), "--environment", "home", "--task", "tidy", "--out", str(tmp_path / "out")]
    assert main(run) == 1
    assert "median depth" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("regions.json", {"rooms": [{"name": "kitchen"}]}),
        ("regions.json", [1, 2]),
        ("regions.json", {"floors": 3, "regions": "x"}),
        ("objects.json", [{"class": "chair", "bbox": [0, 0, 0, 1, 1, 1]}]),
        ("objects.json", {"objects": [{"label": "chair"}]}),
        ("objects.json", {"objects": 4}),
        ("objects.json", {"objects": [{"label": "chair", "min_m": "low", "max_m": "high"}]}),
    ],
)
def test_ground_truth_of_others_is_noted_and_left_out(folder, name, content):
    (folder / name).write_text(json.dumps(content))
    found = truth_beside(open_source(folder))
    assert (found.regions, found.objects) == (None, ())
    assert [finding.verdict for finding in found.findings] == ["note"]
    assert name in found.findings[0].text
    assert "Error" not in found.findings[0].text


def test_ground_truth_of_ours_is_kept(folder):
    box = {"label": "chair", "min_m": [0, 0, 0], "max_m": [1, 1, 1]}
    (folder / "objects.json").write_text(json.dumps({"objects": [box]}))
    (folder / "regions.json").write_text(json.dumps({"floors": [], "regions": []}))
    found = truth_beside(open_source(folder))
    assert found.regions == {"floors": [], "regions": []}
    assert [item.label for item in found.objects] == ["chair"]


def test_progress_is_shown_and_every_frame_is_read(folder):
    seen = []
    recording = look(
        open_source(folder), Config(), Following(Mapping()), progress=lambda done, total: seen.append((done, total))
    )
    assert seen[-1] == (12, 12)
    assert recording.keyframes == 12
    assert not recording.refused


def test_what_the_selection_will_refuse_is_told(folder):
    far = [pose.copy() for pose in POSES]
    for pose in far[6:]:
        pose[:3, 3] += np.random.default_rng(int(pose[0, 3] * 1e6) % 1000).normal(size=3) * 200
    write_poses(folder, far)
    report = check(open_source(folder), Config())
    told = next(finding for finding in report.findings if finding.topic == "keyframes")
    assert told.verdict == "problem" or "its pose jumps by … m" in told.text


def test_reasons_of_many_frames_count_together():
    reason = "its stamp is 0.333 s before the previous frame's"
    assert kind_of(reason) == kind_of(reason.replace("0.333", "-12")) == "its stamp is … s before the previous frame's"
