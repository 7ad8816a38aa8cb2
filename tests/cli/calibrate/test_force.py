"""`mirrorskin calibrate force`: from presses of known force to newtons."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import done, refused, run
from stacks import record

from mirrorskin import io
from mirrorskin.twin import Body, Camera, Sphere, Twin, Vertical

GEL = io.Gel(threshold=np.arctan2(17.5, 40) / 2, compliance=0.0, curvature=1 / 17.5)
MODULUS = 0.12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Presses of a ball to three depths, and their forces."""
    folder, forces = tmp_path_factory.mktemp("presses"), []
    for number, deepest in enumerate((0.4, 0.6, 0.8)):
        twin = Twin(
            object=Sphere(6.0),
            shape=(48, 48),
            pixel_size=0.16,
            movement=Vertical(np.arange(0.04, deepest, 0.04)),
            contact="elastic",
            optics="cylinder",
            camera=Camera(noise=1.0, seed=number),
            body=Body(modulus=MODULUS),
        )
        record(twin, folder / f"press-{number}.h5")
        forces.append(float(twin.truth.force[-1, 2]))
    lines = [f"press-{number}.h5,{force}" for number, force in enumerate(forces)]
    (folder / "scale.csv").write_text("\n".join(["recording,newtons", *lines]))
    return folder, forces


@pytest.fixture(autouse=True)
def here(folder, tmp_path):
    for path in folder[0].iterdir():
        (tmp_path / path.name).symlink_to(path)
    camera = io.CameraId("", (48, 48), np.dtype(np.uint8))
    io.save_calibration(io.Calibration(camera, gel=GEL), "cal.h5")


def test_the_unit_of_the_scale_is_stated_elsewhere_too(folder):
    presses = [f"press-{number}.h5" for number in range(3)]
    for name, text in {
        "column.csv": "recording,force,unit\n"
        + "".join(f"{press},{1000 * force},mN\n" for press, force in zip(presses, folder[1], strict=True)),
        "remark.csv": "# forces in mN\nrecording,force\n"
        + "".join(f"{press},{1000 * force}\n" for press, force in zip(presses, folder[1], strict=True)),
    }.items():
        Path(name).write_text(text)
        done("calibrate force", *presses, "--readings", name, "-o", "cal.h5")
        assert io.open_calibration("cal.h5").stiffness.modulus == pytest.approx(MODULUS, rel=0.03)


def test_presses_and_a_scale_become_a_modulus_that_reconstruct_uses(folder):
    presses = [f"press-{number}.h5" for number in range(3)]
    ended = done("calibrate force", *presses, "--readings", "scale.csv", "-o", "cal.h5")
    assert ended.out.startswith("cal.h5: modulus ")
    assert "held-out forces wrong by" in ended.out
    calibration = io.open_calibration("cal.h5")
    assert calibration.stiffness.modulus == pytest.approx(MODULUS, rel=0.03)
    assert calibration.process["force.sources"] == ", ".join(presses)
    ended = run("reconstruct press-1.h5 --calibration cal.h5 -o a.h5")
    result = io.open_result("a.h5")
    assert "force 0." in ended.out
    text = run("info a.h5").out
    assert "force_sigma" in text
    assert "MPa of the calibration" in text
    assert result.force == pytest.approx(folder[1][1], rel=0.03)
    words = [word for force in folder[1] for word in ("--force", f"{1000 * force}mN")]
    again = run("calibrate force", *presses, *words, "--force-sigma", "1mN", "-o", "cal.h5", "--json")
    report = json.loads(again.out)
    assert report["stiffness"]["modulus"] == pytest.approx(calibration.stiffness.modulus, rel=0.01)
    assert [entry["recording"] for entry in report["presses"]] == presses
    shown = run("calibrate show cal.h5").out
    assert "modulus" in shown
    assert "kPa" in shown


def test_a_modulus_can_be_given(folder):
    run("reconstruct press-1.h5 --calibration cal.h5 --modulus 120kPa -o a.h5")
    assert io.open_result("a.h5").force == pytest.approx(folder[1][1], rel=0.03)
    refused("calibrate elastic first", "reconstruct press-1.h5 --modulus 120kPa -o b.h5")
    assert not Path("b.h5").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "either as --force, one per recording, or as --readings"),
        ("--force 1N --readings scale.csv", "either as --force"),
        ("--force 1N --force 2N", "1 recordings and 2 times --force"),
        ("--force 1mm", "force"),
        ("--force -1N", "a force above 0 is needed; write e.g. 1.5N"),
        ("--readings none.csv", "none.csv: no such file"),
        ("--readings other.csv", "other.csv has no line for press-0.h5"),
        ("--readings bad.csv", "bad.csv, line 2: much: a number and a unit are needed; write e.g. 1.5N"),
        ("--readings comma.csv", "comma.csv, line 2: 'press-0.h5,1,5' is not a recording and a force"),
        ("--force 1N -o new.h5", "new.h5 has no gel"),
    ],
)
def test_a_wrong_call_is_one_line(words, message):
    Path("other.csv").write_text("press-9.h5,1.0\n")
    Path("bad.csv").write_text("name,newtons\npress-0.h5,much\n")
    Path("comma.csv").write_text("name,newtons\npress-0.h5,1,5\n")
    refused(message, f"calibrate force press-0.h5 -o cal.h5 {words}")
