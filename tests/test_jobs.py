"""The dispatcher as a pure machine: nothing lost, nobody overloaded, the least loaded first."""

from hypothesis import given, settings
from hypothesis import strategies as st

from services.runtime.jobs import MAX_ATTEMPTS, QUARANTINE_S, Dispatcher


def test_least_loaded_worker_with_credits():
    dispatcher = Dispatcher(credits=2)
    for job in range(5):
        dispatcher.submit(job, b"")
    dispatcher.worker_up("a")
    dispatcher.worker_up("b")
    assert [(name, job.id) for name, job in dispatcher.assign(0.0)] == [("a", 0), ("b", 1), ("a", 2), ("b", 3)]
    assert dispatcher.assign(0.0) == [] and dispatcher.outstanding == 5
    dispatcher.finished("b", 1)
    assert [(name, job.id) for name, job in dispatcher.assign(0.0)] == [("b", 4)]


def test_a_dead_workers_jobs_go_first_and_in_order():
    dispatcher = Dispatcher(credits=2)
    for job in range(4):
        dispatcher.submit(job, b"")
    dispatcher.worker_up("a")
    dispatcher.assign(0.0)
    dispatcher.worker_down("a")
    dispatcher.worker_up("b")
    assert [job.id for _, job in dispatcher.assign(0.0)] == [0, 1]


def test_a_late_answer_of_a_dead_worker_does_not_count_twice():
    dispatcher = Dispatcher()
    dispatcher.submit(1, b"")
    dispatcher.worker_up("a")
    dispatcher.assign(0.0)
    dispatcher.worker_down("a")
    assert dispatcher.finished("a", 1) is None and dispatcher.outstanding == 1


def test_a_hanging_worker_is_kept_out_and_then_probed_with_one_job():
    dispatcher = Dispatcher(credits=2)
    dispatcher.worker_up("a")
    for job in range(4):
        dispatcher.submit(job, b"")
    dispatcher.assign(0.0)
    dispatcher.failed("a", 0, "timeout", 0.0)
    dispatcher.failed("a", 1, "timeout", 0.0)
    assert dispatcher.assign(1.9 * QUARANTINE_S) == []
    assert len(dispatcher.assign(2 * QUARANTINE_S)) == 1


def test_a_job_that_nobody_can_do_is_given_up():
    dispatcher = Dispatcher()
    dispatcher.worker_up("a")
    dispatcher.submit("bad", b"")
    given_up = None
    for attempt in range(MAX_ATTEMPTS):
        assert len(dispatcher.assign(float(attempt))) == 1
        given_up = dispatcher.failed("a", "bad", "malformed", float(attempt))
    assert given_up is not None and dispatcher.outstanding == 0


EVENTS = st.lists(
    st.tuples(st.sampled_from(["submit", "up", "down", "done", "busy", "timeout", "nobody"]), st.integers(0, 3)),
    max_size=120,
)


@given(EVENTS)
@settings(max_examples=300)
def test_whatever_happens_every_job_is_somewhere(events):
    dispatcher, submitted, finished, now_s = Dispatcher(credits=2), set(), set(), 0.0
    for event, number in events:
        now_s += 0.3
        name = f"w{number}"
        running = list(dispatcher.workers[name].running) if name in dispatcher.workers else []
        if event == "submit":
            submitted.add(len(submitted))
            dispatcher.submit(len(submitted) - 1, b"")
        elif event == "up":
            dispatcher.worker_up(name)
        elif event == "down":
            dispatcher.worker_down(name)
        elif event == "done" and running:
            assert dispatcher.finished(name, running[0]) is not None
            finished.add(running[0])
        elif running:
            given_up = dispatcher.failed(name, running[0], event, now_s)
            if given_up is not None:
                finished.add(given_up.id)
        dispatcher.assign(now_s)
        held = [job.id for job in dispatcher.line] + [j for w in dispatcher.workers.values() for j in w.running]
        assert len(held) == len(set(held)) == dispatcher.outstanding
        assert set(held) | finished == submitted and not set(held) & finished
        assert all(len(worker.running) <= 2 for worker in dispatcher.workers.values())
