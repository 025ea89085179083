"""Jobs that several threads do at the same time."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed


def together(jobs: Sequence[Callable[[threading.Event], None]], threads: int) -> None:
    """Do jobs, by so many threads; the first exception is raised once the others have stopped.

    A job is called with an event: once that is set, what the job still has to do is not wanted any more.
    """
    stopped = threading.Event()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for job in as_completed([pool.submit(job, stopped) for job in jobs]):
                job.result()
        except BaseException:
            stopped.set()
            raise
