"""Priors as JSON: what robots have counted survives a file."""

import json

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.cli import prior_file
from prior_sg.deploy.cli.main import main
from prior_sg.schemas.priors import Counts, Task
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.outside.library import load
from tests.help.world import prior


@pytest.mark.parametrize("looks", [None, 0.5])
def test_what_was_counted_and_what_looks_are_worth_survive_a_file(looks, tmp_path):
    counted = Counts(regions=np.array([2.0, 6.0], np.float32), looks=looks)
    tested = msgspec.structs.replace(prior(["kitchen", "hall"]), tested=counted)
    prior_file.write(tested, tmp_path / "prior.json")
    assert prior_file.read(tmp_path / "prior.json").digest() == tested.digest()


def test_levels_above_the_regions_survive_a_file(tmp_path):
    task = Task(robot="r", stamp_ns=0, environment="campus", task="delivery")
    said = load().answer(task, Config())
    assert len(said.levels) == 2
    prior_file.write(said, tmp_path / "prior.json")
    assert prior_file.read(tmp_path / "prior.json").digest() == said.digest()


def test_a_worth_that_is_no_share_is_refused(tmp_path):
    counted = Counts(regions=np.array([2.0, 6.0], np.float32), looks=0.5)
    path = tmp_path / "prior.json"
    prior_file.write(msgspec.structs.replace(prior(["kitchen", "hall"]), tested=counted), path)
    path.write_text(path.read_text().replace('"tested_looks": 0.5', '"tested_looks": 1.5'))
    with pytest.raises(prior_file.PriorError, match="what looks are worth"):
        prior_file.read(path)


def test_a_matrix_of_names_that_the_prior_does_not_have_is_refused(tmp_path):
    path = tmp_path / "prior.json"
    prior_file.write(prior(["kitchen", "hall"]), path)
    read = json.loads(path.read_text())
    read["adjacency"]["kitchen"]["hal"] = 0.9
    path.write_text(json.dumps(read))
    with pytest.raises(prior_file.PriorError, match="'hal', which the prior does not name"):
        prior_file.read(path)


def test_an_import_into_a_folder_that_cannot_be_written_is_no_import(tmp_path, capsys):
    prior_file.write(prior(["kitchen", "hall"]), tmp_path / "prior.json")
    (tmp_path / "file").touch()
    archive = f"prior_gateway.archive={tmp_path}/file"
    assert main(["priors", "import", f"{tmp_path}/prior.json", "--set", archive]) == 1
    told = capsys.readouterr()
    assert "nothing is imported" in told.err and "from now on" not in told.out
