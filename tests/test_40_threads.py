"""scene: jobs side by side end together, also when one of them fails."""

import threading

import pytest

from tscorr.scene.threads import together


def test_all_jobs_are_done_by_no_more_threads_than_given():
    done, busy, most, lock = [], set(), [], threading.Lock()

    def job(number):
        def work(_):
            with lock:
                busy.add(number)
                most.append(len(busy))
            threading.Event().wait(0.01)
            with lock:
                busy.remove(number)
                done.append(number)

        return work

    together([job(number) for number in range(9)], 3)
    assert sorted(done) == list(range(9))
    assert max(most) == 3


def test_the_first_failure_stops_the_others_and_is_raised():
    """One job would never end by itself, and one that waits for its turn is never wanted."""
    told = []

    def fails(_):
        raise OSError("no room")

    def goes_on(stopped):
        told.append(stopped.wait(60))

    with pytest.raises(OSError, match="no room"):
        together([goes_on, fails, goes_on], 2)
    assert told == [True, True]
