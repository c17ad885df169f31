"""What is read of a run's processes, and how it is summed up."""

import subprocess
import sys

import psutil
import pytest

from prior_sg.deploy.benches.footprint import COMMAND, SERVE, Memory, look, summed
from prior_sg.services.roles import NAMES

IDLE = "import sys, time; print(flush=True); time.sleep(60)"


def every(resident_mb, **of):
    return {name: Memory(of.get(name, resident_mb), 1.0) for name in (*NAMES, COMMAND)}


def test_processes_are_known_by_their_service_and_workers_are_one():
    named = ("segmenter", "feature_pyramid", "feature_pyramid", "no_service_of_ours")
    modules = [SERVE, SERVE, SERVE, "another.module"]
    processes = [
        subprocess.Popen([sys.executable, "-c", IDLE, module, name], stdout=subprocess.PIPE)
        for module, name in zip(modules, named, strict=True)
    ]
    try:
        for process in processes:
            process.stdout.readline()
        found = look(psutil.Process())
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert set(found) == {COMMAND, "segmenter", "feature_pyramid"}
    assert found["feature_pyramid"].resident_mb == pytest.approx(2 * found["segmenter"].resident_mb, rel=0.1)
    assert 0 < found["segmenter"].share_mb <= found["segmenter"].resident_mb


def test_start_end_and_most_of_each_and_of_all():
    start = {"segmenter": Memory(50.0, 20.0)}
    partly = {"segmenter": Memory(900.0, 900.0)}  # while the others are gone
    found = summed(start, [every(100.0), every(100.0, segmenter=400.0), every(120.0), partly])
    assert (found["segmenter_start_mb"], found["segmenter_end_mb"], found["segmenter_most_mb"]) == (50.0, 120.0, 400.0)
    assert found["segmenter_start_share_mb"] == 20.0 and "ingest_start_mb" not in found
    assert (found["total_end_mb"], found["total_most_mb"], found["total_end_share_mb"]) == (840.0, 1000.0, 7.0)


def test_a_run_that_never_stood_has_no_figures():
    with pytest.raises(RuntimeError, match="never stood"):
        summed({}, [{COMMAND: Memory(1.0, 1.0)}])
