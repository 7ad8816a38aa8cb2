"""Every block of Python or shell of the documentation runs, or states why it does not.

The blocks of a page run from top to bottom in a folder, with the files and names of `FILES` and `NAMES`; a
comment above a block, ``<!-- not run: REASON -->``, excludes it.
"""

import re
import shlex
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from commands import done
from moved_surfaces import bumpy
from right_scores import check_score
from simulated import simulated_rig

from mirrorskin import engine, io

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^(?:<!-- not run: ([^\n]+) -->\n)?```(python|sh)\n(.*?)^```", re.DOTALL | re.MULTILINE)
ELSEWHERE = {  # pages that other tests run, because they check more
    "README.md": "test_readme.py",
    "docs/operations.md": "cli/test_run.py",
    "docs/tutorial.md": "test_tutorial.py",
    "docs/twin.md": "test_readme.py",
}
SMALL = "--size 48x40 --pixel-size 0.25mm --frames"
FILES = {  # commands that write what the blocks of a page take for granted
    "docs/app.md": [f"simulate vertical {SMALL} 12 -o sphere.h5"],
    "docs/formats.md": [
        f"simulate vertical {SMALL} 12 -o press.h5",
        "reconstruct press.h5 -o res.h5",
    ],
    "docs/method/focus.md": [f"simulate vertical {SMALL} 12 -o stack.h5"],
    "docs/method/fusion.md": [
        f"simulate vertical {SMALL} 12 -o press.h5",
        f"simulate axial {SMALL} 8 --pattern linear -o turn.h5",
    ],
    "docs/method/measures.md": [
        f"simulate vertical {SMALL} 12 -o press.h5",
        "reconstruct press.h5 -o first.h5",
        "reconstruct press.h5 -o second.h5",
    ],
    "docs/method/sensor-health.md": [
        f"simulate vertical {SMALL} 12 -o press.h5",
        "reconstruct press.h5 -o first.h5",
        "reconstruct press.h5 -o second.h5",
    ],
    "docs/method/photometric-stereo.md": [f"simulate axial {SMALL} 8 -o turn.h5"],
    "docs/method/press.md": [f"simulate vertical {SMALL} 12 -o press.h5"],
    "docs/recordings.md": [f"simulate vertical {SMALL} 12 -o coin.h5"],
}
RIGS = {"docs/capture.md", "docs/stages.md", "docs/touch.md"}  # pages with an emulated rig, rig.toml


def pages():
    """Return the name and the blocks of each page: reason not to run, language, text."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    texts = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in paths}
    return {name: blocks for name, text in texts.items() if (blocks := BLOCK.findall(text))}


PAGES = pages()


def touch(number):
    """Return a result of a surface that lies a little further each time."""
    x, y = io.pixel_axes((60, 80), (0.05, 0.05))
    shape = bumpy(x + 0.02 * number, y[:, np.newaxis])[0]
    noise = np.random.default_rng(number).normal(0, 1e-3, shape.shape)
    height, sigma = (shape + noise).astype(np.float32), np.full(shape.shape, 1e-3, np.float32)
    return io.Result(height=height, height_sigma=sigma, x=x, y=y)


def touches():
    """Return results of touches, which are also in files."""
    results = [touch(number) for number in range(3)]
    for number, result in enumerate(results):
        io.save_result(result, f"touch-{number}.h5")
    return {"engine": engine, "first": results[0], "second": results[1], "results": results}


def folder():
    """Put a recording in a folder."""
    Path("data").mkdir()
    done(f"simulate vertical {SMALL} 12 -o data/one.h5")
    return {}


def stack():
    """Return frames of a press, with their travel, which are also in files of NumPy."""
    frames = np.zeros((12, 40, 48), np.uint8)
    frames[6:] = 200
    np.save("frames.npy", frames)
    return {"np": np, "frames": frames, "travel": 0.1 * np.arange(12)}


def film():
    """Return a video of three frames, and a stage that moves between them."""
    frames, place = iter(np.zeros((3, 480, 640, 3), np.uint8)), iter((0.0, 0.1, 0.2))
    grabbed = iter((True, True, True, False))
    video = SimpleNamespace(grab=lambda: next(grabbed), retrieve=lambda: (True, next(frames)))
    stage = SimpleNamespace(position=lambda: next(place))
    return {"engine": engine, "cv2": cv2, "video": video, "stage": stage, "show": str}


def speckles():
    """Return frames of a texture that slides by a pixel of 0.03 mm a frame."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (64, 80)), (0, 0), 1.5)
    frames = np.stack([np.roll(texture, number, axis=1) for number in range(4)]).astype(np.uint8)
    positions = np.column_stack([0.03 * np.arange(4.0), np.zeros(4)])
    row, column = np.indices(frames.shape[1:])
    contact = (np.hypot(row - 31.5, column - 39.5) < 24).astype(np.uint8)
    return {
        "slip": engine.slip,
        "reference": frames[0],
        "frames": frames,
        "pixel_size": 0.03,
        "contact": contact,
        "positions": positions,
    }


def dragged():
    """Return an object, and the displacement of a skin that it drags in the middle of the picture."""
    row, column = np.mgrid[-1:1:48j, -1:1:64j]
    touching = np.hypot(row, column) < 0.5
    displacement = np.dstack([0.05 * touching, 0 * row])
    names = {"pixel_size": 0.05, "modulus": 0.1, "touching": touching, "sigma": 1e-3}
    height = -0.3 * (row**2 + column**2)
    return {"engine": engine, "height": height, "displacement": displacement, **names}


def arrays():
    """Return frames of a press and of a rotation, with what is known of them."""
    levels = {"dark": 16.0, "bright": 216.0, "gain": 150.0, "offset": 0.0, "tilt": 0.05}
    positions = {"travel": 0.1 * np.arange(12), "phase": np.pi / 4 * np.arange(8)}
    press, turn = np.zeros((12, 40, 48), np.uint8), np.zeros((8, 40, 48), np.uint8)
    return {**levels, **positions, "press_frames": press, "turn_frames": turn}


NAMES = {  # what the Python of a page takes for granted
    "docs/batch.md": folder,
    "docs/formats.md": stack,
    "docs/live.md": film,
    "docs/method/force.md": dragged,
    "docs/method/fusion.md": arrays,
    "docs/method/pose.md": touches,
    "docs/method/slip.md": speckles,
}
SLOW = {"docs/app.md", "docs/capture.md"}  # half a minute on a busy machine
RUN = [
    pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
    for name, blocks in PAGES.items()
    if name not in ELSEWHERE and any(not reason for reason, *_ in blocks)
]


@pytest.mark.parametrize("name", RUN)
def test_the_blocks_of_a_page_run(name, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    rig = simulated_rig(tmp_path, (40, 48), rate=40.0, delay=0.02, pattern="linear")
    with rig if name in RIGS else nullcontext():
        run_blocks(name)
    assert "failed" not in capsys.readouterr().out  # what a batch reports


def run_blocks(name):
    """Write the files of a page, and run its blocks in the working directory."""
    for line in FILES.get(name, ()):
        done(line)
    names = NAMES.get(name, dict)()
    for reason, language, text in PAGES[name]:
        if reason:
            continue
        if language == "python":
            exec(text, names)
            continue
        for line in lines_in(text):
            words = words_of(line)[1:]
            done(*words)
            if words[0] == "score" and name != "docs/method/slip.md":  # which has no heights
                check_score(words, line.partition("#")[2])


@pytest.mark.parametrize("name", PAGES)
def test_shell_that_runs_consists_of_commands_of_mirrorskin(name):
    text = "".join(text for reason, language, text in PAGES[name] if language == "sh" and not reason)
    others = {words_of(line)[0] for line in lines_in(text)} - {"mirrorskin"}
    assert others <= ({"echo"} if name == "docs/tutorial.md" else set())


def lines_in(text):
    """Return the commands of a shell block, with their comments."""
    return [line for line in text.replace("\\\n", " ").splitlines() if words_of(line)]


def words_of(line):
    return shlex.split(line, comments=True)
