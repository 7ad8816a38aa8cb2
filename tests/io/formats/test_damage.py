"""Every format refuses damaged files in one line, and writes nothing.

The suffixes come from the declarations, and intact files from ``SAMPLES`` in the tests of the formats.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from commands import refused, run

from mirrorskin.io.formats import registry

READERS = [form for form in registry.formats(installed=False) if form.reader]
SUFFIXES = sorted({suffix for form in READERS for suffix in form.suffixes if suffix != registry.FOLDER})
IMPORT = ("--motion", "vertical", "--travel-step", "0.1mm", "-o", "rec.h5")


def samples():
    """Return functions that write a few frames to a path, by the file's name."""
    writers = {}
    for file in Path(__file__).parent.glob("test_*.py"):
        if file != Path(__file__) and "\nSAMPLES = {" in file.read_text(encoding="utf-8"):
            spec = importlib.util.spec_from_file_location(f"samples_of_{file.stem}", file)
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            writers |= module.SAMPLES
    return writers


SAMPLES = samples()


def write_directory(path):
    path.mkdir()


CONTENT = {
    "empty": lambda path: path.write_bytes(b""),
    "a text": lambda path: path.write_text("frames, of which there are none\n" * 20),
    "zeros": lambda path: path.write_bytes(bytes(4096)),
    "noise": lambda path: path.write_bytes(np.random.default_rng(0).bytes(4096)),
    "a directory": write_directory,
}


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_every_reader_has_a_sample():
    suffixes = {Path(name).suffix or registry.FOLDER for name in SAMPLES}
    without = [form.name for form in READERS if form.source and not suffixes & set(form.suffixes)]
    assert without == []


@pytest.mark.parametrize("content", CONTENT)
@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("line", ["import", "info"])
def test_a_file_that_is_not_of_its_format_is_refused(line, suffix, content):
    path = Path(f"a{suffix}")
    CONTENT[content](path)
    refused(path.name, line, path, *(IMPORT if line == "import" else ()))


@pytest.fixture(params=SAMPLES)
def sample(request):
    """A file of frames; of a folder, its first file."""
    path = Path(request.param)
    SAMPLES[path.name](path)
    return path, min(path.iterdir()) if path.is_dir() else path


def test_an_intact_file_is_imported(sample):
    assert run("import", sample[0], *IMPORT).code == 0


@pytest.mark.parametrize("kept", [0.02, 0.3, 0.6, 0.9])
def test_a_truncated_file_is_refused(sample, kept):
    path, file = sample
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * kept)])
    refused(path.name, "import", path, *IMPORT)


def test_a_file_whose_first_bytes_are_flipped_is_refused(sample):
    path, file = sample
    data = file.read_bytes()
    file.write_bytes(bytes(byte ^ 0xFF for byte in data[:16]) + data[16:])
    refused(path.name, "import", path, *IMPORT)


def test_flipped_bytes_are_imported_or_refused(sample):
    path, file = sample
    data = file.read_bytes()
    for place in np.random.default_rng(1).integers(0, len(data), 40):
        file.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :])
        ended = run("import", path, *IMPORT)
        assert ended.code in (0, 2), (place, ended)
        if ended.code == 2:
            errors = [text for text in ended.said.splitlines() if text.startswith("mirrorskin: ")]
            assert len(errors) == 1, (place, ended)
            assert not Path("rec.h5").exists()
        Path("rec.h5").unlink(missing_ok=True)
