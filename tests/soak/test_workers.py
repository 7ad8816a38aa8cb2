import os
import random
import time

import distributed
import pytest
import soak

from mirrorskin.engine.batch import cluster
from mirrorskin.engine.batch.cluster import run_cluster
from mirrorskin.engine.batch.jobs import Plan, make_jobs

pytestmark = pytest.mark.slow

WORKERS = 2


@pytest.fixture(scope="module")
def workers():
    """A scheduler, and workers that are processes and are started again when they end."""
    with (
        cluster._local_cluster(WORKERS) as running,
        distributed.Client(running, set_as_default=False) as client,
    ):
        yield client


def wait_for(workers):
    """Wait until all are there; one that ends before its nanny knows of it would not be started again."""
    deadline = time.monotonic() + 60
    while {nanny.status.name for nanny in workers.cluster.workers.values()} != {"running"}:
        assert time.monotonic() < deadline, "workers do not come back"
        time.sleep(0.01)
    workers.wait_for_workers(WORKERS, timeout=60)


@pytest.mark.parametrize("seed", soak.seeds())
def test_a_job_whose_worker_is_killed_is_done_by_another(
    seed, workers, recordings, undisturbed, tmp_path, caplog
):
    chance, start = random.Random(seed), time.monotonic()
    wait_for(workers)
    victim, delay = chance.choice(recordings), chance.uniform(0, 0.04)
    workers.run(soak.die_with, victim.name, delay, tmp_path / "died")
    outcomes = list(run_cluster(make_jobs(recordings, tmp_path), Plan(), workers.scheduler.address))

    count_done = int((tmp_path / "died").read_text())
    assert caplog.text.count("was lost") <= 1, outcomes  # it may be back before anyone looks
    states = [outcome.state for outcome in outcomes]
    assert states.count("done") + states.count("kept") == len(recordings)
    assert states.count("kept") <= 2  # saved, and nobody was told yet
    assert soak.all_data(tmp_path) == undisturbed
    fraction = len(os.sched_getaffinity(0)) // WORKERS
    threads = set(workers.run(os.getenv, "POCL_MAX_PTHREAD_COUNT").values())
    assert threads <= {
        str(max(1, fraction)),
        str(fraction + 1),
        None,
    }  # None: it came back, and did nothing yet
    assert threads != {None}
    rest = len(recordings) - count_done
    soak.ROUNDS.append(soak.Round("worker", seed, count_done, rest, time.monotonic() - start))
