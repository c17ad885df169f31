"""Task and prior in force: the newest task, the latest prior that answers it, whatever the order of arrival."""

import itertools

from prior_sg.schemas.priors import PriorList, PriorRequest, TaskInForce
from prior_sg.services import intent
from prior_sg.services.intent import Intent
from tests.help.world import prior, task


def test_the_newest_task_is_in_force_in_every_order_of_arrival():
    tasks = [task(robot="ada", stamp_ns=stamp) for stamp in (3, 5, 7)]
    for order in itertools.permutations(tasks):
        known = Intent()
        for message in order:
            intent.hear(known, message)
        assert known.tasks["ada"] == tasks[-1]


def test_only_a_task_that_comes_into_force_is_told():
    known = Intent()
    assert intent.hear(known, task(robot="ada", stamp_ns=5))
    assert not intent.hear(known, TaskInForce(robot="ada", task=task(robot="ada", stamp_ns=4)))
    assert not intent.hear(known, TaskInForce(robot="ada")) and not intent.hear(known, prior(["kitchen"]))
    assert intent.hear(known, TaskInForce(robot="ada", task=task(robot="ada", stamp_ns=5)))


def test_robots_have_priors_of_their_own_and_the_best_of_a_list_counts():
    known, kitchen, hall = Intent(), prior(["kitchen"]), prior(["hall"], "clean")
    for message in (task(robot="ada"), task("clean", robot="bob"), PriorList(priors=[kitchen, hall])):
        intent.hear(known, message)
    assert intent.prior_in_force(known, "ada") == (kitchen.digest(), kitchen)
    assert intent.prior_in_force(known, "bob") == (hall.digest(), hall)
    assert intent.prior_in_force(known, "eve") is None
    intent.hear(known, PriorList(priors=[prior(["best"]), prior(["second"])]))
    assert intent.prior_in_force(known, "ada")[1].regions[0].name == "best"


def test_a_prior_is_asked_for_as_long_as_none_answers():
    known = Intent()
    assert not list(intent.prior_question(known, "ada"))
    intent.hear(known, task(robot="ada", regions=["kitchen"]))
    asked = PriorRequest(environment="home", task="tidy up", regions=["kitchen"])
    assert list(intent.prior_question(known, "ada")) == list(intent.prior_question(known, "ada")) == [asked]
    intent.hear(known, prior(["kitchen"], vocabulary=["kitchen"]))
    assert not list(intent.prior_question(known, "ada"))


def test_of_too_many_priors_the_oldest_that_answer_nobody_go_first():
    known, own = Intent(remembered=2), prior(["kitchen"])
    for message in (task(robot="ada"), own, prior(["a"], "other"), prior(["b"], "another")):
        intent.hear(known, message)
    assert [kept.task for kept in known.priors.values()] == [own.task, "another"]
