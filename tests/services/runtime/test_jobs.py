"""The dispatcher as a pure machine: nothing lost, nobody overloaded, the least loaded first."""

from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.services.runtime.jobs.board import ABANDONED_S, NO_WORKER, Board
from prior_sg.services.runtime.jobs.dispatcher import MAX_ATTEMPTS, OVERDUE_LEAST_S, QUARANTINE_S, Dispatcher


def test_least_loaded_worker_with_credits():
    dispatcher = Dispatcher(credits=2)
    for job in range(5):
        dispatcher.submit(job, b"")
    dispatcher.worker_up("a")
    dispatcher.worker_up("b")
    assert [(name, job.id) for name, job in dispatcher.assign(0.0)] == [("a", 0), ("b", 1), ("a", 2), ("b", 3)]
    assert dispatcher.assign(0.0) == [] and dispatcher.outstanding == 5
    dispatcher.finished("b", 1, 0.0)
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
    assert dispatcher.finished("a", 1, 0.0) is None and dispatcher.outstanding == 1


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


def test_a_slow_worker_gets_less():
    """Two workers, one five times slower: jobs go by the pace each has shown, about five to one."""
    dispatcher, now_s, got = Dispatcher(credits=2), 0.0, {"fast": 0, "slow": 0}
    for job in range(120):
        dispatcher.submit(job, b"")
    due = []
    for name in got:
        dispatcher.worker_up(name)
    free_s = {"fast": 0.0, "slow": 0.0}
    while dispatcher.outstanding:
        for name, job in dispatcher.assign(now_s):
            free_s[name] = max(free_s[name], now_s) + {"fast": 0.1, "slow": 0.5}[name]
            due.append((free_s[name], name, job.id))
        due.sort()
        now_s, name, job_id = due.pop(0)
        if dispatcher.finished(name, job_id, now_s) is not None:
            got[name] += 1
    assert sum(got.values()) == 120 and 4 <= got["fast"] / got["slow"] <= 6
    assert now_s < 10.6  # 120 jobs at 12 a second, and one slow job


def test_an_overdue_workers_jobs_go_to_others_too_and_count_once():
    dispatcher = Dispatcher(credits=2)
    for name in ("a", "b"):
        dispatcher.worker_up(name)
    for job in range(4):
        dispatcher.submit(job, b"")
    assert len(dispatcher.assign(0.0)) == 4
    for at_s, name, job in ((0.1, "a", 0), (0.1, "b", 1), (0.2, "b", 3)):
        assert dispatcher.finished(name, job, at_s).id == job
    assert dispatcher.next_time_s(0.2) == 0.1 + OVERDUE_LEAST_S
    assert dispatcher.assign(0.1 + OVERDUE_LEAST_S - 0.01) == []
    again = dispatcher.assign(0.1 + OVERDUE_LEAST_S)
    assert [(name, job.id) for name, job in again] == [("b", 2)]
    assert dispatcher.outstanding == 1
    dispatcher.submit(9, b"")
    assert [name for name, _ in dispatcher.assign(0.9)] == ["b"]  # nothing new for the suspect
    assert dispatcher.finished("b", 2, 1.0).id == 2
    assert dispatcher.finished("a", 2, 5.0) is None  # the suspect answers after all: done twice, counted once
    dispatcher.finished("b", 9, 5.0)
    assert dispatcher.outstanding == 0
    dispatcher.submit(10, b"")
    assert len(dispatcher.assign(5.0)) == 1 and not dispatcher.workers["a"].suspected


def test_a_suspects_answer_takes_the_job_out_of_the_line():
    dispatcher = Dispatcher(credits=1)
    dispatcher.worker_up("a")
    dispatcher.submit(1, b"")
    dispatcher.assign(0.0)
    assert dispatcher.assign(100.0) == []  # nobody else is there: the job waits in the line as well
    assert len(dispatcher.line) == 1 and dispatcher.outstanding == 1
    assert dispatcher.finished("a", 1, 101.0).id == 1
    assert dispatcher.outstanding == 0


def test_skipping_to_the_newest():
    dispatcher = Dispatcher(credits=1, limit=2)
    dispatcher.worker_up("a")
    dispatcher.submit(0, b"")
    dispatcher.assign(0.0)
    skipped = [job.id for number in range(1, 6) for job in dispatcher.submit(number, b"")]
    assert skipped == [1, 2, 3] and [job.id for job in dispatcher.line] == [4, 5]


def test_jobs_for_later_give_way():
    dispatcher = Dispatcher(credits=1)
    dispatcher.submit("old", b"", later=True)
    dispatcher.submit("new", b"")
    dispatcher.worker_up("a")
    assert [job.id for _, job in dispatcher.assign(0.0)] == ["new"]
    assert dispatcher.outstanding == 1
    dispatcher.finished("a", "new", 1.0)
    assert [job.id for _, job in dispatcher.assign(1.0)] == ["old"]


def test_every_group_does_every_job_and_it_ends_with_the_last():
    board = Board()
    assert board.submit(1, b"") == []  # nobody is there yet
    board.worker_up("a", "x/1")
    board.submit(2, b"")
    board.worker_up("b", "y")
    board.submit(3, b"")
    given, ended = board.assign(0.0)
    wanted = [("a", 1), ("a", 2), ("a", 3), ("b", 2), ("b", 3)]
    assert sorted((name, job.id) for name, job in given) == wanted and not ended
    assert [job.id for job in board.finished("a", 1, 0.1)] == [1]  # it came before the second group's first
    board.finished("b", 3, 0.2)
    assert [job.id for job in board.finished("a", 3, 0.2)] == [3]
    assert board.finished("a", 2, 0.2) == []
    (last,) = board.finished("b", 2, 0.3)
    assert (last.id, last.worker, last.error) == (2, "b", "")


def test_a_job_for_one_group_goes_nowhere_else():
    board = Board()
    board.worker_up("a", "x")
    board.worker_up("b", "y")
    assert board.assign(0.0) == ([], [])
    board.submit(1, b"", "y", later=True)
    assert [(name, job.id) for name, job in board.assign(0.0)[0]] == [("b", 1)]
    assert [job.id for job in board.finished("b", 1, 1.0)] == [1]


def test_a_group_that_is_left_leaves_its_jobs_to_the_others():
    board = Board(credits=1)
    board.worker_up("a", "x")
    for number in (1, 2):
        board.submit(number, b"")
    board.assign(0.0)
    board.worker_up("b", "y")
    board.assign(0.0)
    board.finished("b", 2, 0.0)  # the newest one, for a start
    board.submit(3, b"")
    board.submit(4, b"", "x")
    board.worker_down("a", 1.0)
    given, ended = board.assign(ABANDONED_S)
    assert [(name, job.id) for name, job in given] == [("b", 3)] and not ended
    assert board.next_time_s(ABANDONED_S) <= 1.0 + ABANDONED_S
    board.finished("b", 3, ABANDONED_S)
    given, ended = board.assign(1.0 + ABANDONED_S)
    assert [(job.id, job.error) for job in ended] == [(2, ""), (3, ""), (4, NO_WORKER)]  # y did 2, 3; 4 was for x alone
    assert [(name, job.id) for name, job in given] == [("b", 1)]
    assert [job.id for job in board.finished("b", 1, 12.0)] == [1] and board.outstanding == 0


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["submit", "up", "down", "done", "busy", "timeout", "nobody", "wait"]), st.integers(0, 3)
    ),
    max_size=120,
)


@given(EVENTS)
@settings(max_examples=300)
def test_whatever_happens_every_job_is_somewhere(events):
    dispatcher, submitted, finished, now_s = Dispatcher(credits=2), set(), set(), 0.0
    for event, number in events:
        now_s += 5.0 if event == "wait" else 0.3  # long enough for every worker to be suspected
        name = f"w{number}"
        running = list(dispatcher.workers[name].running) if name in dispatcher.workers else []
        if event == "submit":
            submitted.add(len(submitted))
            dispatcher.submit(len(submitted) - 1, b"")
        elif event == "up":
            dispatcher.worker_up(name)
        elif event == "down":
            finished |= {job.id for job in dispatcher.worker_down(name)}
        elif event == "done" and running:
            if dispatcher.finished(name, running[0], now_s) is not None:
                assert running[0] not in finished
                finished.add(running[0])
        elif running and event != "wait":
            given_up = dispatcher.failed(name, running[0], event, now_s)
            if given_up is not None:
                assert given_up.id not in finished
                finished.add(given_up.id)
        dispatcher.assign(now_s)
        held = [job.id for job in dispatcher.open_jobs()]
        assert len(held) == len(set(held)) == dispatcher.outstanding
        assert set(held) | finished == submitted and not set(held) & finished
        assert len({job.id for job in dispatcher.line}) == len(dispatcher.line)
        assert all(len(worker.running) <= 2 for worker in dispatcher.workers.values())
