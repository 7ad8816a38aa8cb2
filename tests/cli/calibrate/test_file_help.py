"""``mirrorskin calibrate`` lists its commands, and help imports nothing slow."""

import subprocess
import sys

COMMANDS = ("references", "board", "scale", "tilt", "zenith", "elastic", "check", "show")
HEAVY = ("numpy", "scipy", "h5py", "cv2", "pyopencl", "matplotlib")


def help_of(*words):
    code = (
        f"import sys; sys.argv = ['mirrorskin', *{words!r}, '--help']\n"
        "from mirrorskin.cli.main import main\n"
        "try:\n    main()\nfinally:\n"
        f"    print('heavy:', *[name for name in {HEAVY!r} if name in sys.modules])\n"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_calibrate_names_its_commands_and_is_quick():
    text = help_of("calibrate")
    assert all(f"\n  {command} " in text for command in COMMANDS)
    assert text.endswith("heavy:\n")
