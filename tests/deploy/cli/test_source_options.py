"""Options of reading: each is a setting of ingest that exists, and reaches the config."""

import pytest

from prior_sg.deploy.cli.main import build_parser
from prior_sg.deploy.cli.source_options import OPTIONS, read_options, source_settings
from prior_sg.deploy.errors import UserError
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.runtime.config import ConfigError

RUN = ["run", "home", "--environment", "home", "--task", "tidy up"]


def test_every_option_is_a_setting_and_every_setting_but_the_robot_an_option():
    settings = {option.setting for option in OPTIONS}
    assert settings == set(ReadOptions.__struct_fields__) - {"source_robot"}


@pytest.mark.parametrize("command", [RUN, ["up"], ["pack", "home", "home.mcap"]])
def test_options_reach_the_config_of_whoever_reads(command):
    given = ["--depth-scale", "0.0002", "--distortion=-0.3,0.1,0,0", "--up", "0,-1,0", "--stamp-offset", "-0.5"]
    arguments = build_parser().parse_args([*command, *given, "--origin", "1,2,3", "--poses", "camera_from_world"])
    options = read_options(arguments)
    assert (options.depth_scale_m, options.distortion, options.world_up) == (0.0002, [-0.3, 0.1, 0, 0], [0, -1, 0])
    assert (options.stamp_offset_s, options.origin, options.poses) == (-0.5, "1,2,3", "camera_from_world")
    assert source_settings(build_parser().parse_args(command)) == []


@pytest.mark.parametrize(("flag", "value"), [("--depth-scale", "inf"), ("--intrinsics", "1,2"), ("--origin", "here")])
def test_an_option_that_cannot_be_meant_is_one_sentence(flag, value):
    with pytest.raises(ConfigError) as error:
        read_options(build_parser().parse_args([*RUN, flag, value]))
    assert "\n" not in str(error.value)


def test_a_robot_is_heard_on_the_domain_of_ros_environment_unless_told(monkeypatch):
    def domain(source, *more):
        return read_options(build_parser().parse_args(["run", source, *RUN[2:], *more])).ros_domain

    monkeypatch.setenv("ROS_DOMAIN_ID", "5")
    assert domain("ros2:/") == 5
    assert domain("ros2:/", "--domain", "7") == 7
    assert domain("walk.bag") == 0
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(UserError, match="ROS_DOMAIN_ID 'many' is no domain"):
        domain("ros2:/")
    monkeypatch.delenv("ROS_DOMAIN_ID")
    assert domain("ros2:/") == 0
