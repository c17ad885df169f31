"""A robot and an edge server as two hosts, set up by the commands of docs/security.md, over a link that has trouble.

    python -m tests.help.two_hosts --cut 30 --delay 50 --loss 2 --rate 2M --thin-link 2M --observe

As root. Prints one line of JSON: what the scene holds, what differs from a run in one process, what the link carried.
"""

import argparse
import contextlib
import io
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np
from rich.console import Console

from prior_sg.deploy.api.history import open_history
from prior_sg.deploy.cli.main import main as command
from prior_sg.deploy.cli.shared import rate_in
from prior_sg.deploy.running.job import Job, run
from prior_sg.deploy.sample import SAMPLE
from prior_sg.schemas.topics import KEYFRAME
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime.record import LogWriter, read_log
from tests.help.hosts import Network
from tests.help.paths import ROOT

ROBOT, TASK, ENVIRONMENT = "robot7", "serve drinks", "residential home"
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
PLACES = ("place_ids", "positions_m", "radii_m", "edges", "clearances_m")


def documented():
    """The commands that docs/security.md gives for a robot and an edge, in their order."""
    text = (ROOT / "docs" / "security.md").read_text().partition("## A robot and an edge server")[2]
    return [line for block in SHELL.findall(text)[:2] for line in block.splitlines() if line]


def stream(path, frames):
    """The first frames of the sample."""
    with LogWriter(path) as log:
        for logged in list(read_log(SAMPLE, [KEYFRAME]))[:frames]:
            log.add(
                logged.topic, logged.key, logged.payload, logged.writer, logged.sequence, logged.sent_ns,
                logged.received_ns,
            )  # fmt: skip
    return path


class TwoHosts:
    """A network of an edge server and a robot; `speed` is that of the stream, options go to the commands of `up`. With
    `more_workers` a third host encodes, too."""

    def __init__(self, folder, network, frames=10, speed=1.0, options="", *, more_workers=False):
        self.folder, self.frames = folder, frames
        self.edge, self.robot = network.host("edge"), network.host("robot")
        self.gpu = network.host("gpu") if more_workers else None
        self.to_gpu = network.link(self.edge, self.gpu) if self.gpu else None
        self.gpu_to = self.edge.address
        self.link = network.link(self.edge, self.robot)
        self.source = stream(folder / "stream.mcap", frames)
        self._speed, self._options = speed, options
        self.environment = os.environ | {
            "HOME": str(folder), "XDG_CONFIG_HOME": str(folder / ".config"), "PYTHONPATH": str(ROOT / "src"),
            "PSG_KEYS": "", "XDG_CACHE_HOME": os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache")),
        }  # fmt: skip

    def _words(self, line):
        """A documented command, with this network's names."""
        for said, meant in (
            ("~", str(self.folder)), ("edge1:7448", f"{self.edge.address}:7448"), ("/data", str(self.source)),
        ):  # fmt: skip
            line = line.replace(said, meant)
        return [sys.executable, "-m", "prior_sg.deploy.cli.main", *shlex.split(line)[1:]]

    def begin(self):
        """Follow the document to its end: keys, both hosts, the task. Returns what the last command said."""
        said = None
        for line in [said for said in documented() for said in self._with_gpu(said)]:
            if line.startswith("scp"):
                _, _, bundle, copy = shlex.split(line)
                shutil.copytree(bundle.replace("~", str(self.folder)), self.folder / copy.replace(":", "/"))
            elif line.startswith("export"):
                name, _, value = line.removeprefix("export ").partition("=")
                self.environment[name] = value.replace("~", str(self.folder))
            elif line.startswith("prior-sg keys"):
                with mock.patch.dict(os.environ, self.environment), contextlib.redirect_stdout(io.StringIO()):
                    assert command(shlex.split(line)[1:]) == 0
            elif line.startswith("prior-sg up"):
                self._up(line)
                if self.gpu is not None and "--listen" in line:
                    self._encode_elsewhere()
            else:  # the timeout is for busy machines
                said = self.edge.run(*self._words(line), "--timeout", 600, env=self.environment, timeout_s=700)
                assert said.returncode == 0, said.stdout + said.stderr
        return said.stdout

    def _with_gpu(self, line):
        """A documented command, and the same for the third host's bundle."""
        if self.gpu is None or "edge1" not in line or line.startswith("prior-sg up") or "task" in line:
            return [line]
        return [line, line.replace("edge1", "gpu1")]

    def _encode_elsewhere(self):
        """Workers on the third host, by the command of docs/security.md."""
        text = (ROOT / "docs" / "security.md").read_text().partition("More workers on another machine")[2]
        line = next(line for line in SHELL.findall(text)[0].splitlines() if line.startswith("prior-sg up"))
        words = self._words(line.replace("edge1:7448", f"{self.gpu_to}:7448"))
        words[words.index("--keys") + 1] = self.folder / "gpu1" / "keys"
        out = ("--out", self.folder / "gpu1" / "out")
        self.gpu.start(*words, *out, log=self.folder / "gpu1.txt", env=self.environment)
        self._wait(lambda: len(self.encoders()) == 2, 300, "the second worker")

    def encoders(self):
        """How many keyframes each worker has taken, by its name on the bus."""
        words = [sys.executable, "-m", "prior_sg.deploy.cli.main", "health", "--json"]
        told = json.loads(self.edge.run(*words, env=self.environment).stdout or "{}")
        workers = [p for p in told.get("processes", []) if p["service"] == "feature_pyramid"]
        return {p["instance"]: sum(t["consumed"] for t in p["topics"] if t["topic"] == "ENCODE") for p in workers}

    def _up(self, line):
        name, host = ("edge1", self.edge) if "--listen" in line else ("robot7", self.robot)
        words = [*self._words(line), *shlex.split(self._options), "--speed", self._speed]
        words[words.index("--keys") + 1] = self.folder / name / "keys"
        host.start(*words, "--out", self.folder / name / "out", log=self.folder / f"{name}.txt", env=self.environment)
        if host is self.edge:
            self._wait(lambda: "router" in (self.folder / "edge1.txt").read_text(), 300, "the edge's router")

    def observe(self):
        """Somebody on the edge who reads all that the robot says."""
        observer = Path(__file__).with_name("observer.py")
        words = [sys.executable, observer, "tcp/127.0.0.1:7447", ROBOT, self.folder / "seen.json"]
        return self.edge.start(*words, log=self.folder / "observer.txt", env=self.environment)

    def scene(self):
        """What the edge's store holds now; None before it holds anything."""
        database = self.folder / "edge1" / "out" / "scene.sqlite"
        with contextlib.suppress(PriorSgError), open_history(database) as history:
            return history.scene(ROBOT).message if ROBOT in history.robots else None
        return None

    def mapped(self, number):
        """Wait until so many keyframes are in the scene."""
        self._wait(lambda: (s := self.scene()) is not None and len(s.trajectory) >= number, 600, f"{number} keyframes")

    def settled(self, quiet_s=4.0, timeout_s=600):
        """The scene once all keyframes are in it, all places are labelled, and nothing changes any more."""
        last, since_s = None, time.monotonic()

        def rests():
            nonlocal last, since_s
            scene = self.scene()
            state = None if scene is None else (scene.revision, len(scene.trajectory))
            if state != last:
                last, since_s = state, time.monotonic()
            done = scene is not None and len(scene.trajectory) == self.frames and (scene.place_regions >= 0).all()
            return done and time.monotonic() - since_s > quiet_s

        self._wait(rests, timeout_s, "a scene that rests")
        while self.health()["segmenter"]["PYRAMID"]["consumed"] < self.frames:  # on a busy machine one is under way
            last, since_s = None, time.monotonic()
            self._wait(rests, timeout_s, "a scene that rests")
        return self.scene()

    def health(self):
        """Per service and topic what was consumed and lost, as `prior-sg health --json` says on the edge."""
        words = [sys.executable, "-m", "prior_sg.deploy.cli.main", "health", "--json"]
        told = json.loads(self.edge.run(*words, env=self.environment).stdout)
        return {p["service"]: {t["topic"]: t for t in p["topics"]} for p in told["processes"]}

    def _wait(self, condition, timeout_s, what):
        end_s = time.monotonic() + timeout_s
        while not condition():
            for host in filter(None, (self.edge, self.robot, self.gpu)):
                for process in host.processes:
                    assert process.poll() is None, self.logs()
            assert time.monotonic() < end_s, f"{what} did not come\n{self.logs()}"
            time.sleep(0.2)

    def logs(self):
        files = [*self.folder.glob("*.txt"), *self.folder.glob("*/out/logs/*.log")]
        return "\n".join(f"== {file}\n{file.read_text()[-1500:]}" for file in files)


def alone(folder, source):
    """The scene of the same stream in one process."""
    job = Job(
        source=str(source), out=folder / "alone", environment=ENVIRONMENT, task=TASK, robot=ROBOT, in_process=True
    )
    return run(job, Console(quiet=True)).scene


def differences(scene, other):
    """What of the map differs, and the share of places with another label."""
    different = [name for name in PLACES if not np.array_equal(getattr(scene, name), getattr(other, name))]
    names = [{region.id: region.label for region in one.regions} for one in (scene, other)]
    labels = [
        dict(zip(one.place_ids.tolist(), (of.get(r, "") for r in one.place_regions.tolist()), strict=True))
        for one, of in zip((scene, other), names, strict=True)
    ]
    both = labels[0].keys() & labels[1].keys()
    return different, sum(labels[0][place] != labels[1][place] for place in both) / max(len(both), 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--cut", type=float, default=0.0, help="seconds without a link, in mid-stream")
    parser.add_argument("--delay", type=float, default=0.0, help="ms each way")
    parser.add_argument("--loss", type=float, default=0.0, help="per cent of packets each way")
    parser.add_argument("--rate", type=rate_in, default=0.0, help="bits per second each way")
    parser.add_argument("--thin-link", default="", help="as of `prior-sg up`")
    parser.add_argument("--observe", action="store_true", help="somebody on the edge reads all that the robot says")
    parser.add_argument("--more-workers", action="store_true", help="a third host encodes, too")
    arguments = parser.parse_args()
    options = f"--thin-link {arguments.thin_link}" if arguments.thin_link else ""
    with tempfile.TemporaryDirectory() as name, Network() as network:
        folder = Path(name)
        pair = TwoHosts(
            folder, network, arguments.frames, arguments.speed, options, more_workers=arguments.more_workers
        )
        pair.link.delay_s, pair.link.loss, pair.link.bps = arguments.delay / 1e3, arguments.loss / 100, arguments.rate
        pair.begin()
        observer = pair.observe() if arguments.observe else None
        if arguments.cut:
            pair.mapped(arguments.frames // 3)
            pair.link.cut = True
            time.sleep(arguments.cut)
            pair.link.cut = False
        began_s = time.monotonic()
        scene = pair.settled()
        report = {"settled_after_s": round(time.monotonic() - began_s, 1), "keyframes": len(scene.trajectory)}
        report |= {"health": {s: {t: _counts(c) for t, c in ts.items()} for s, ts in pair.health().items()}}
        if arguments.more_workers:
            report["encoded_by"] = pair.encoders()
        if observer is not None:
            observer.terminate()
            observer.wait(20)
            report["seen_on_the_edge"] = json.loads((folder / "seen.json").read_text())
        report |= {"link_bytes": {"to robot": pair.link.bytes[0], "to edge": pair.link.bytes[1]}}
        report["packets_lost"] = sum(pair.link.lost)
        different, share = differences(scene, alone(folder, pair.source))
        report |= {"places": len(scene.place_ids), "map differs in": different, "labels differ": round(share, 3)}
    print(json.dumps(report))


def _counts(count):
    return {name: count[name] for name in ("consumed", "missed", "malformed", "limited", "duplicate") if count[name]}


if __name__ == "__main__":
    main()
