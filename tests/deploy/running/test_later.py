"""Who lacks what can come back is started again for as long as it takes; who cannot start ends the run."""

import subprocess
import time

import pytest

from prior_sg.deploy.running import supervisor as supervising
from prior_sg.deploy.running.serve import EXIT_HOPELESS, EXIT_LATER
from prior_sg.deploy.running.supervisor import GIVE_UP_AFTER, Child, ChildFailed, Supervisor


def checked(tmp_path, monkeypatch, codes):
    """What a supervisor says of a child that ends with one code after the other."""
    waiting = iter(codes)

    def start(child):
        child.process = subprocess.Popen(["sh", "-c", f"exit {next(waiting)}"])
        child.process.wait()
        child.started_s = time.monotonic()

    monkeypatch.setattr(Child, "start", start)
    monkeypatch.setattr(supervising, "LATER_DELAY_S", 0.0)
    monkeypatch.setattr(supervising, "RESTART_DELAY_S", 0.0)
    child = Child("scene_store", "scene_store-1", [], tmp_path / "log", 1)
    child.log_path.write_text('{"event": "the disk is full"}\n')
    child.start()
    supervisor = Supervisor("", "robot1", tmp_path, children=[child])
    return [event for _ in range(2 * len(codes) - 1) for event in supervisor.check()]


def test_who_lacks_what_can_come_back_is_started_again_and_again(tmp_path, monkeypatch):
    codes = [EXIT_LATER] * 3 * GIVE_UP_AFTER + [EXIT_HOPELESS, EXIT_LATER]
    said = checked(tmp_path, monkeypatch, codes)
    assert sum("restarted" in text for text in said) == len(codes) - 1
    assert said[0] == f"scene_store-1 ended (exit status {EXIT_LATER}): the disk is full; restarting"


@pytest.mark.parametrize("codes", [[EXIT_HOPELESS], [1] * GIVE_UP_AFTER, [EXIT_LATER, 1, EXIT_HOPELESS]])
def test_who_cannot_start_ends_the_run(tmp_path, monkeypatch, codes):
    with pytest.raises(ChildFailed, match="the disk is full"):
        checked(tmp_path, monkeypatch, codes)
