"""Set-ups that are broken on purpose: each is named by `prior-sg doctor`, with the command that mends it."""

import json
import os
import resource
import shutil
import socket
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, contextmanager
from datetime import UTC, datetime, timedelta

import pytest
import zenoh

from prior_sg.deploy import limits
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.inspecting.doctor.findings import Finding, Here, OnTheBus, clock_off_s, findings
from prior_sg.deploy.inspecting.health import Found
from prior_sg.deploy.keys.authority import Authority
from prior_sg.schemas.codec import encode
from prior_sg.schemas.status import ServiceStatus, TopicCount
from prior_sg.schemas.topics import alive_key, status_key
from prior_sg.services.refusals import CLOCK_SET_NS
from prior_sg.services.runtime import zenoh_session
from prior_sg.services.runtime.extras import release
from prior_sg.services.runtime.keys import ABOUT_FILE, KEY_FILE, VARIABLE
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.storage import open_storage
from prior_sg.services.scene_store.storage.tables import LAYOUT_VERSION

WRITER = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
for statement in sys.argv[2].split(";"):
    connection.execute(statement)
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def said(tmp_path, monkeypatch, capsys):
    """Its findings by topic, as `--json` tells them; the exit status fits them, and every line holds its command."""
    monkeypatch.setenv(VARIABLE, "")

    def say(*words, out=tmp_path / "out"):
        options = [*words, "--out", str(out)]
        status = main(["doctor", "--json", *options])
        told = json.loads(capsys.readouterr().out)
        found = [Finding(**one) for one in told["findings"]]
        assert status == (1 if found else 0) and told["well"] is not bool(found)
        assert all(one.mend and one.mend in one.line() and "\n" not in one.line() for one in found)
        return found

    return say


def only(found, topic):
    """The one finding, which is about this."""
    assert [one.topic for one in found] == [topic], found
    return found[0]


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_sound_set_up_has_no_finding(said, endpoint):
    with process(endpoint):
        assert said("--connect", endpoint) == []
    assert said("--before") == []


def test_it_tells_a_line_each_and_their_number(said, capsys, tmp_path):
    assert main(["doctor", "--before", "--out", str(tmp_path), "--set", "segmenter.betta=1"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and lines[0].startswith("settings: segmenter has no setting") and lines[1] == "1 finding"


def test_a_port_that_a_foreign_program_has(said, monkeypatch):
    monkeypatch.setattr(zenoh_session, "CONNECT_MS", 300)
    with socket.create_server(("127.0.0.1", 0)) as foreign:
        endpoint = f"tcp/127.0.0.1:{foreign.getsockname()[1]}"
        one = only(said("--connect", endpoint), "router")
    assert f"{endpoint} is taken by a program that is no router" in one.text
    assert one.mend.startswith("prior-sg up --connect tcp/127.0.0.1:") and not one.mend.endswith(endpoint)


def test_no_router(said):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    one = only(said("--connect", endpoint), "router")
    assert f"no router answers on {endpoint}" in one.text and one.mend == "prior-sg up"


@pytest.mark.parametrize("connect", ["tcp/192.0.2.7:7447", "tls/192.0.2.7:7448"])
def test_beyond_this_host_without_keys(said, connect):
    assert only(said("--connect", connect), "router").mend == "prior-sg keys init"


def test_an_endpoint_that_is_none(said):
    assert "--connect takes PROTOCOL/HOST:PORT" in only(said("--connect", "7447"), "router").text


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    made = Authority.create(tmp_path_factory.mktemp("keys"))
    made.add("robot", "robot7")
    return made


@pytest.fixture
def bundle(authority, tmp_path, said):
    folder = shutil.copytree(authority.bundle("robot7"), tmp_path / "bundle")
    return folder


def told_of(bundle, **changes):
    """bundle.json with changes to its own participant."""
    about = json.loads((bundle / ABOUT_FILE).read_text())
    about["participants"][0] |= changes
    (bundle / ABOUT_FILE).write_text(json.dumps(about))


def test_keys_that_are_good(said, bundle):
    assert said("--before", "--keys", str(bundle)) == []


def test_keys_that_have_expired(said, bundle):
    yesterday = (datetime.now(UTC) - timedelta(days=1)).date().isoformat()
    told_of(bundle, until=yesterday)
    one = only(said("--before", "--keys", str(bundle)), "keys")
    assert f"expired since {yesterday}" in one.text and one.mend == "prior-sg keys rotate robot7"


def test_keys_that_are_revoked(said, bundle):
    told_of(bundle, revoked=True)
    assert only(said("--before", "--keys", str(bundle)), "keys").mend == "prior-sg keys add robot robot7"


def test_keys_that_others_may_read_and_a_folder_without(said, bundle, tmp_path):
    (bundle / KEY_FILE).chmod(0o640)
    assert only(said("--before", "--keys", str(bundle)), "keys").mend == f"chmod 600 {bundle / KEY_FILE}"
    assert "no bundle of keys" in only(said("--before", "--keys", str(tmp_path)), "keys").text


def status(**changes):
    fields = {"service": "maker", "instance": "maker-1", "robot": "r", "pid": 7, "uptime_s": 1.0, "backlog": 0}
    fields |= {"busy_share": 0.0, "step_ms_p50": 0.0, "step_ms_p99": 0.0, "resident_mb": 1.0, "waiting_for": []}
    return ServiceStatus(**(fields | {"topics": [], "clock_ns": time.time_ns(), "release": release()} | changes))


@contextmanager
def process(endpoint, schema="ServiceStatus/1", **changes):
    """A process on the bus that tells this of itself whenever it is asked."""
    key = status_key("maker", "maker-1")
    with closing(ZenohBus(endpoint)) as bus:
        encoding = zenoh.Encoding("application/msgpack").with_schema(schema)

        def tell(query):
            query.reply(key, encode(status(**changes)), encoding=encoding)

        bus._entities.append(bus._session.declare_queryable(key, tell, complete=True))
        bus.announce(alive_key("maker", "maker-1"))
        yield


def test_a_clock_that_is_off(said, endpoint):
    with process(endpoint, clock_ns=time.time_ns() + 90 * 10**9):
        one = only(said("--connect", endpoint), "clock")
    assert "maker-1 (pid 7) runs is" in one.text and "s ahead of this host's" in one.text
    assert one.mend == "timedatectl set-ntp true"


def test_a_service_of_a_newer_message_version(said, endpoint):
    with process(endpoint, "ServiceStatus/2"):
        one = only(said("--connect", endpoint), "versions")
    assert "ServiceStatus/2 is newer than this program's ServiceStatus/1" in one.text and "pip install" in one.mend


def test_a_service_of_another_release_that_cannot_read_what_it_gets():
    old = status(release="", topics=[TopicCount(topic="KEYFRAME", malformed=3), TopicCount(topic="TASK")])
    versions, messages = findings(Here(), OnTheBus(found=Found([old]), to_ns=2**62, release="9.9"))
    assert "maker-1 (pid 7) runs an older prior-sg" in versions.text and "this is 9.9" in versions.text
    assert "could not read 3 of KEYFRAME" in messages.text


@pytest.mark.parametrize(("told_s", "off_s"), [(0, 0), (15, 0), (25, 5), (4, -6)])
def test_a_clock_is_off_by_what_lies_outside_of_the_asking(told_s, off_s):
    assert clock_off_s(told_s * 10**9, 10 * 10**9, 20 * 10**9) == off_s


def test_a_clock_that_was_never_set():
    assert only(findings(Here(clock_ns=CLOCK_SET_NS - 1), OnTheBus()), "clock").mend == "timedatectl set-ntp true"


def test_a_full_disk(said, monkeypatch, tmp_path):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=5_000_000))
    assert "only 5 MB are free" in only(said("--before"), "disk").text


def test_a_folder_that_cannot_be_written(said, tmp_path):
    file = tmp_path / "file"
    file.touch(0o755)
    assert "cannot be written" in only(said("--before", out=file / "out"), "disk").text


@pytest.mark.parametrize("variable", ["NUMBA_CACHE_DIR", "XDG_CACHE_HOME"])
def test_a_cache_that_cannot_be_written(said, monkeypatch, variable):
    monkeypatch.setenv(variable, "/dev/null")
    assert only(said("--before"), "cache").mend == f"export {variable}=FOLDER"


@pytest.fixture
def database(tmp_path):
    """A scene database where `up` has it."""
    path = tmp_path / "out/scene.sqlite"
    open_storage(Config(path=str(path))).close()
    return path


def seen(folder):
    return {file.name: (file.read_bytes(), file.stat().st_mtime_ns) for file in sorted(folder.iterdir())}


def test_looking_at_a_database_leaves_it_as_it_is_also_after_a_crash(said, database, tmp_path):
    before = seen(database.parent)
    assert said("--before") == [] and seen(database.parent) == before
    with closing(sqlite3.connect(database, isolation_level=None)) as connection:
        connection.execute("INSERT INTO robots (name) VALUES ('r')")  # is in the log, not yet in the file
        left = shutil.copytree(database.parent, tmp_path / "left")
    before = seen(left)
    assert len(before) == 3 and said("--before", out=left) == [] and seen(left) == before
    (left / "scene.sqlite-shm").unlink()
    with (left / "scene.sqlite").open("r+b") as file:  # as where a power cut ended a checkpoint, which the log mends
        file.seek(8192)
        file.write(bytes(4096))
    before = seen(left)
    assert said("--before", out=left) == [] and seen(left) == before


@pytest.mark.parametrize(
    "way", ["BEGIN IMMEDIATE", "PRAGMA locking_mode = EXCLUSIVE; INSERT INTO robots VALUES (1, 'r')"]
)
def test_a_database_that_another_process_keeps_locked(said, database, way):
    command = [sys.executable, "-c", WRITER, str(database), way]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        writer.stdout.readline()
        one = only(said("--before"), "database")
        writer.stdin.close()
    assert f"locked all the time by the process {writer.pid}" in one.text and one.mend == f"kill {writer.pid}"


def test_a_damaged_database(said, database):
    data = bytearray(database.read_bytes())
    data[4096:] = os.urandom(len(data) - 4096)
    database.write_bytes(data)
    assert only(said("--before"), "database").mend == f"mv {database} {database}.aside"
    database.write_bytes(b"no database at all" * 100)
    assert only(said("--before"), "database").mend == f"mv {database} {database}.aside"


def test_a_database_of_a_newer_version(said, database):
    with closing(sqlite3.connect(database)) as connection:
        connection.execute(f"PRAGMA user_version = {LAYOUT_VERSION + 1}")
    one = only(said("--before"), "database")
    assert f"it holds layout {LAYOUT_VERSION + 1}" in one.text and "pip install --upgrade" in one.mend


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[segmenter]\nbetta = 2.0\n", "segmenter has no setting 'betta'"),
        ("[segmentor]\nbeta = 2.0\n", "there is no service 'segmentor'"),
        ("[feature_pyramid]\noverlap = 2.0\n", "overlap must be in [0, 1)"),
        ("[feature_pyramid\n", "cannot read the configuration"),
    ],
)
def test_a_configuration_that_is_wrong(said, tmp_path, text, told):
    file = tmp_path / "robot.toml"
    file.write_text(text)
    one = only(said("--before", "--config", str(file)), "settings")
    assert told in one.text and one.mend == f"$EDITOR {file}"


def test_every_wrong_layer_is_named(said, monkeypatch):
    monkeypatch.setenv("PSG_SEGMENTER__BETTA", "1")
    monkeypatch.setenv("PSG_SEGMENTER__SPACE", "x")
    first, second = said("--before", "--set", "feature_pyramid.layers=0")
    assert {first.mend, second.mend} == {"unset PSG_SEGMENTER__BETTA", "prior-sg up --set SERVICE.FIELD=VALUE"}


def test_an_encoder_whose_files_are_not_there(said, tmp_path):
    assert "has no manifest.json" in only(said("--before", "--encoder", f"onnx:{tmp_path}"), "encoder").text
    assert said("--before", "--encoder", "conse/efficientnet-lite0/minilm-l6-v2") == []


def test_an_encoder_whose_extra_is_not_there(said, monkeypatch):
    monkeypatch.setattr("prior_sg.services.runtime.extras.find_spec", lambda name: None if name == "torch" else True)
    one = only(said("--before", "--encoder", "conse/efficientnet-lite0/minilm-l6-v2"), "packages")
    assert "torch" in one.text and one.mend == "pip install 'prior-sg[encode]'"
    assert said("--before") == []  # nobody asked for one


def test_a_client_without_services_is_told_of_no_more_than_it_asked(said, monkeypatch):
    monkeypatch.setattr("prior_sg.services.runtime.extras.find_spec", lambda name: None)
    assert said("--before") == []
    assert only(said("--before", "--set", "segmenter.beta=2"), "packages").mend == "pip install 'prior-sg[map]'"


def test_too_few_files(said, monkeypatch):
    monkeypatch.setattr(limits.resource, "getrlimit", lambda which: (20, 20))
    assert {one.topic for one in said("--before")} == {"memory", "open files"}  # both limits are that low
    monkeypatch.setattr(
        limits.resource, "getrlimit", lambda which: (20, 20) if which == resource.RLIMIT_NOFILE else (-1, -1)
    )
    one = only(said("--before"), "open files")
    assert "only 20 files may be open at once" in one.text and one.mend == "sudo prlimit --pid $$ --nofile=1024"
