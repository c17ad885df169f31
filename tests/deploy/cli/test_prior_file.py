"""Priors as JSON: what robots have counted survives a file."""

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.cli import prior_file
from prior_sg.schemas.priors import Counts
from tests.help.world import prior


@pytest.mark.parametrize("looks", [None, 0.5])
def test_what_was_counted_and_what_looks_are_worth_survive_a_file(looks, tmp_path):
    counted = Counts(regions=np.array([2.0, 6.0], np.float32), looks=looks)
    tested = msgspec.structs.replace(prior(["kitchen", "hall"]), tested=counted)
    prior_file.write(tested, tmp_path / "prior.json")
    assert prior_file.read(tmp_path / "prior.json").digest() == tested.digest()


def test_a_worth_that_is_no_share_is_refused(tmp_path):
    counted = Counts(regions=np.array([2.0, 6.0], np.float32), looks=0.5)
    path = tmp_path / "prior.json"
    prior_file.write(msgspec.structs.replace(prior(["kitchen", "hall"]), tested=counted), path)
    path.write_text(path.read_text().replace('"tested_looks": 0.5', '"tested_looks": 1.5'))
    with pytest.raises(prior_file.PriorError, match="what looks are worth"):
        prior_file.read(path)
