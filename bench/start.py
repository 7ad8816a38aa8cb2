"""A process of its own that starts as a user's does, and measures what each step takes; run as a script.

It imports nothing of the benchmarks, which take longer to import than the engine does.
"""

import hashlib
import json
import sys
import time
from typing import Any


def main() -> None:
    """Import, open a device, and do each work twice; print seconds of each, and a hash of the answers."""
    seconds = {}
    begun = time.perf_counter()

    def note(what: str) -> None:
        nonlocal begun
        now = time.perf_counter()
        seconds[what] = now - begun
        begun = time.perf_counter()

    import numpy as np

    from mirrorskin import engine
    from mirrorskin.kernels.device import open_device

    note("import")
    device = open_device(sys.argv[1])
    note("open device")

    count, rows, columns = (int(number) for number in sys.argv[2:5])
    generator = np.random.default_rng(0)
    place = generator.uniform(2, count - 2, (rows, columns))
    number = np.arange(count)[:, np.newaxis, np.newaxis]
    light = 20 + 200 * (number >= place) + generator.normal(0, 1.5, (count, rows, columns))
    press, travel = np.rint(light).clip(0, 255).astype(np.uint8), 0.05 * np.arange(count)
    phase = 2 * np.pi * np.arange(8) / 8
    wave = 100 + 9 * np.cos(phase[:, np.newaxis, np.newaxis] - place)
    turn = np.rint(wave + generator.normal(0, 1.5, wave.shape)).astype(np.uint8)
    dz_dx, dz_dy = generator.normal(0, 0.1, (2, rows, columns)).astype(np.float32)
    mask = place > 2.5

    scale: dict[str, Any] = {"tilt": 0.0436, "gain": 180.0, "offset": 16.0}
    works = {
        "press": lambda: engine.find_onset(press, travel, dark=20, bright=220, device=device).height,
        "turn": lambda: engine.estimate_normals(turn, phase, **scale, device=device).vectors,
        "surface": lambda: engine.integrate(dz_dx, dz_dy, 0.03, mask=mask, sigma=False, device=device).height,
    }
    compiling, answers = {}, hashlib.sha256()
    for name in sys.argv[5:]:
        for which in ("first", "second"):
            device.profile.clear()
            begun = time.perf_counter()
            answer = works[name]()
            note(f"{which} {name}")
            records = device.profile.records()
            compiling[f"{which} {name}"] = sum(one.seconds for one in records if one.kind == "compile")
            answers.update(np.ascontiguousarray(answer).tobytes())
    found = {"seconds": seconds, "compile": compiling, "answers": answers.hexdigest()}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
