import random
import signal
import time

import pytest
import soak
from commands import run

pytestmark = pytest.mark.slow

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


@pytest.mark.parametrize("seed", soak.seeds())
@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
def test_a_batch_goes_on_where_it_was_ended(number, seed, recordings, undisturbed, tmp_path):
    chance, start, folder = random.Random(seed), time.monotonic(), tmp_path / "results"
    batch = soak.Batch(recordings, folder)
    text = batch.end(number, chance.randrange(len(recordings) - 2), chance.uniform(0, 0.1))

    before = soak.results(folder)
    assert soak.all_data(folder).items() <= undisturbed.items()
    if batch.code == 0:  # on a quick machine, all was done before the signal came
        assert len(before) == len(recordings)
    elif number == signal.SIGKILL:
        assert batch.code == -number
    else:
        assert batch.code == 128 + number
        assert "the same command resumes it" in text
        assert "Traceback" not in text
        assert soak.leftovers(folder) == []

    again = run("batch", *recordings, "-o", folder)
    rest = len(recordings) - len(before)
    assert again.code == 0
    assert f"{rest} done, {len(before)} kept, 0 failed" in again.out
    assert before.items() <= soak.results(folder).items()
    assert soak.all_data(folder) == undisturbed
    assert soak.leftovers(folder) == []
    soak.ROUNDS.append(soak.Round(number.name, seed, len(before), rest, time.monotonic() - start))
