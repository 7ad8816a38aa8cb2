"""All cases: the estimators' from Python, and the commands'."""

import calibration_cases  # noqa: F401
import command_cases  # noqa: F401
import engine_cases  # noqa: F401
import movement_cases  # noqa: F401
from golden import CASES

__all__ = ["CASES"]
